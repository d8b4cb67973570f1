// One HTTP request with a time limit. Each way to fail has its own words: a fault of this page is none of the server's.

export const PATIENCE_S = 10;
const BROKE_OFF = "The server’s answer broke off. Try again.";

/** A refusal by the server, or no answer from it (`status` 0); `message` says what happened and what to do. */
export class Refusal extends Error {
  constructor(message, status) {
    super(message);
    this.name = "Refusal";
    this.status = status;
  }
}

/**
 * Resolve to `instead` where a Refusal holds nothing up.
 * @template T, U
 * @param {Promise<T>} pending
 * @param {U} [instead]
 * @returns {Promise<T | U>}
 */
export async function unlessRefused(pending, instead = null) {
  try {
    return await pending;
  } catch (error) {
    if (!(error instanceof Refusal)) throw error;
    return instead;
  }
}

/**
 * Send a request; resolve to the response and its body as text. Rejects with a Refusal of status 0 if no whole answer
 * comes, and with an AbortError after `stop`. Any other error is a fault of this page, and is not caught here.
 * @param {string} path
 * @param {RequestInit} options
 * @param {{patienceS?: number, stop?: AbortSignal | null}} [limits] `patienceS` holds until the body is whole
 */
export async function sendRequest(path, options, { patienceS = PATIENCE_S, stop = null } = {}) {
  // By hand: AbortSignal.any and the TimeoutError of AbortSignal.timeout are newer than our oldest browsers.
  const limit = new AbortController();
  const abort = () => limit.abort();
  let isLate = false;
  const timer = setTimeout(() => { isLate = true; abort(); }, 1e3 * patienceS);
  stop?.addEventListener("abort", abort);
  if (stop?.aborted) abort();
  try {
    // Made first: from here on a TypeError is one of the network, by the specification of fetch.
    const request = new Request(path, { ...options, cache: "no-store", signal: limit.signal });
    const response = await orRefusal(fetch(request), "The server cannot be reached. Is it running, and is this device in its network?");
    return { response, text: await orRefusal(response.text(), BROKE_OFF) };
  } catch (error) {
    if (isLate) throw new Refusal(`The server did not answer within ${patienceS} s. Try again.`, 0);
    // Firefox breaks requests off when the page is left.
    if (!limit.signal.aborted && /** @type {Error} */ (error).name === "AbortError") throw new Refusal(BROKE_OFF, 0);
    throw error;
  } finally {
    clearTimeout(timer);
    stop?.removeEventListener("abort", abort);
  }
}

/**
 * A failure of the network becomes a Refusal with these words.
 * @template T
 * @param {Promise<T>} pending
 * @param {string} words
 */
async function orRefusal(pending, words) {
  try {
    return await pending;
  } catch (error) {
    throw error instanceof TypeError ? new Refusal(words, 0) : error;
  }
}

/**
 * Load a module when it is wanted; a Refusal if its file does not come.
 * @template T
 * @param {() => Promise<T>} load
 */
export async function loadModule(load) {
  try {
    return await load();
  } catch (error) {
    // Chrome, Firefox and Safari have no kind of error for it, but words.
    if (!/import\w+ (?:a )?module/i.test(String(error))) throw error;
    throw new Refusal("A part of this page could not be loaded. Is the server running? Then load the page again.", 0);
  }
}

/**
 * Parse an answer as JSON; a Refusal if it is none: something between this page and the server wrote it, or it was cut.
 * @param {Response} response
 * @param {string} text
 */
export function parseAnswer(response, text) {
  try {
    return JSON.parse(text);
  } catch {
    throw new Refusal(response.ok
      ? "The answer is not one of FootTile’s server, or not all of it. If this network has a login page or a proxy, look there; then load this page again."
      : `The server refused: ${response.status} ${response.statusText}`.trim() + ".", response.ok ? 0 : response.status);
  }
}
