// HTTP request with a time limit. Each failure has its own text; a fault of this page is not reported as one of the server.

export const TIMEOUT_S = 10;
const INCOMPLETE = "The response is incomplete. Try again.";

/** Refusal by the server, or no response (`status` 0); `message` states cause and remedy. */
export class Refusal extends Error {
  constructor(message, status) {
    super(message);
    this.name = "Refusal";
    this.status = status;
  }
}

/**
 * After a Refusal resolve to what `instead` makes of it.
 * @template T, U
 * @param {Promise<T>} pending
 * @param {(refusal: Refusal) => U} [instead]
 * @returns {Promise<T | U>}
 */
export async function unlessRefused(pending, instead = () => null) {
  try {
    return await pending;
  } catch (error) {
    if (!(error instanceof Refusal)) throw error;
    return instead(error);
  }
}

/**
 * Send a request; resolve to the response and its body as text. Reject with a Refusal of status 0 if the response is
 * missing or incomplete, and with an AbortError after `stop`. Other errors are faults of this page.
 * @param {string} path
 * @param {RequestInit} options
 * @param {{timeoutS?: number, stop?: AbortSignal | null}} [limits] `timeoutS` includes the body
 */
export async function sendRequest(path, options, { timeoutS = TIMEOUT_S, stop = null } = {}) {
  // By hand: AbortSignal.any and the TimeoutError of AbortSignal.timeout are newer than the oldest browsers.
  const limit = new AbortController();
  const abort = () => limit.abort();
  let isLate = false;
  const timer = setTimeout(() => { isLate = true; abort(); }, 1e3 * timeoutS);
  stop?.addEventListener("abort", abort);
  if (stop?.aborted) abort();
  try {
    // Request first: after it a TypeError is one of the network (specification of fetch).
    const request = new Request(path, { ...options, cache: "no-store", signal: limit.signal });
    const response = await orRefusal(fetch(request), "The server cannot be reached. Check that it runs and that this device is in its network.");
    return { response, text: await orRefusal(response.text(), INCOMPLETE) };
  } catch (error) {
    if (isLate) throw new Refusal(`The server did not answer within ${timeoutS} s. Try again.`, 0);
    // Firefox aborts requests when the page is left.
    if (!limit.signal.aborted && /** @type {Error} */ (error).name === "AbortError") throw new Refusal(INCOMPLETE, 0);
    throw error;
  } finally {
    clearTimeout(timer);
    stop?.removeEventListener("abort", abort);
  }
}

/**
 * Turn a network failure into a Refusal.
 * @template T
 * @param {Promise<T>} pending
 * @param {string} text
 */
async function orRefusal(pending, text) {
  try {
    return await pending;
  } catch (error) {
    throw error instanceof TypeError ? new Refusal(text, 0) : error;
  }
}

/**
 * Load a module on demand; reject with a Refusal if its file does not load.
 * @template T
 * @param {() => Promise<T>} load
 */
export async function loadModule(load) {
  try {
    return await load();
  } catch (error) {
    // Browsers have no error type for it, only a message.
    if (!/import\w+ (?:a )?module/i.test(String(error))) throw error;
    throw new Refusal("A part of this page could not be loaded. Check that the server runs, then reload.", 0);
  }
}

/**
 * Parse a response as JSON; throw a Refusal if it is cut or not from the server.
 * @param {Response} response
 * @param {string} text
 */
export function parseResponse(response, text) {
  try {
    return JSON.parse(text);
  } catch {
    throw new Refusal(response.ok
      ? "The response is incomplete or not from a FootTile server. Check for a login page or proxy in this network, then reload."
      : `The server refused: ${response.status} ${response.statusText}`.trim() + ".", response.ok ? 0 : response.status);
  }
}
