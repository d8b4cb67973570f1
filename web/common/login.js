// Login: a ticket or token in the URL, or a typed token, becomes a cookie that scripts cannot read.

import { showDialog } from "./dialogs.js";
import { parseResponse, Refusal, sendRequest } from "./request.js";
import { el, setText } from "./text.js";

const PATH = "/api/v1/login";
const HOW = "For a login link run “foottile invite” on the server's computer, or enter the server's token.";
const LOGIN_NEEDED = `Log in to tare, record or change sessions. ${HOW}`;
const PRIVATE = `This server is private: log in to view. ${HOW}`;
const ENDED = `Your login has ended: server restarted, or 12 hours passed. ${HOW}`;
const VIEWER = `You are logged in as viewer (read-only). ${HOW}`;
const COOKIE_BLOCKED = "Login accepted, but the browser blocks cookies of this address. "
  + "Allow them, or leave the private window; then reload this page.";
const WRONG = `That is not this server's token. ${HOW}`;

/** Login state from the server; null: not received yet. */
let state = null;
let refused = ""; // why a ticket or token of the URL was refused
let chip = null;

/** Return true if controls are shown: not to viewers. Without a login the page asks for one on use. */
export const isOperator = () => state?.role !== "viewer";
/** Return true if a private server requires a login. */
export const needsLogin = () => Boolean(state?.private) && state.role === null;

/** Log in with a ticket or token of the URL, and remove it there, so that it is not shared by accident. */
export async function logInFromUrl() {
  const fields = new URLSearchParams(location.hash.slice(1));
  const [ticket, token] = [fields.get("ticket"), fields.get("token")];
  if (ticket === null && token === null) {
    await look();
    return;
  }
  fields.delete("ticket");
  fields.delete("token");
  const rest = fields.toString();
  history.replaceState(null, "", location.pathname + location.search + (rest ? `#${rest}` : ""));
  const answer = await logIn(ticket === null ? {} : { ticket }, token);
  if (answer.ok) return;
  refused = answer.detail;
  await look();
  if (state?.role) refused = ""; // logged in already: URL opened twice
  draw();
}

// A new fragment in the same tab does not load the page.
addEventListener("hashchange", async () => {
  if (!/[#&](ticket|token)=/.test(location.hash)) return;
  await logInFromUrl();
  if (!refused) location.reload();
});

/** Update the login state; resolve to true if the server responded. */
export async function look() {
  return (await request("GET")).ok;
}

/** Ask for a login until there is one; after a cancel wait for a click. */
export async function waitForLogin() {
  while (needsLogin() && !await askToLogIn()) await new Promise((resolve) => chip.addEventListener("click", resolve, { once: true }));
}

let asking = null;
/** Show one login dialog for all refused calls; resolve to true after a login. */
export function askToLogIn() {
  asking ??= dialogUntilLogin().finally(() => { asking = null; });
  return asking;
}

async function dialogUntilLogin() {
  if (!refused) await look(); // may have ended
  let why = refused ? asSentence(refused) : state?.ended ? ENDED : state?.role === "viewer" ? VIEWER : needsLogin() ? PRIVATE : LOGIN_NEEDED;
  refused = "";
  for (;;) {
    const token = await enterToken(why);
    if (!token) return false;
    const answer = await logIn({}, token);
    if (answer.ok) return true;
    why = answer.status === 401 ? WRONG : asSentence(answer.detail);
  }
}

async function enterToken(why) {
  const field = el("input", { id: "token-field", type: "password", autocomplete: "off" });
  const content = [el("p", { id: "token-why", text: why }), el("label", { text: "Token " }, field)];
  const entered = await showDialog("token", "Log in", content, el("button", { type: "submit", value: "ok", text: "Log in" }));
  return entered ? field.value.trim() : "";
}

/** Return text with a full stop. @param {string} text */
const asSentence = (text) => (/[.!?]$/.test(text) ? text : `${text}.`);

/** Log in, and check that the browser sends the cookie back. */
async function logIn(body, token) {
  const answer = await request("POST", body, token);
  if (!answer.ok) return answer;
  const now = await request("GET");
  return now.ok && state.role === null ? { ok: false, status: 0, detail: COOKIE_BLOCKED } : now;
}

/** Get or change the login; resolve to the result. */
async function request(method, body, token = null) {
  const headers = { Accept: "application/json" };
  if (body) headers["Content-Type"] = "application/json";
  if (token) headers.Authorization = `Bearer ${token}`;
  let response, answer;
  try {
    let text;
    ({ response, text } = await sendRequest(PATH, { method, headers, body: body && JSON.stringify(body) }));
    answer = parseResponse(response, text);
  } catch (error) {
    if (!(error instanceof Refusal)) throw error;
    return { ok: false, status: error.status, detail: error.message };
  }
  if (!response.ok) return { ok: false, status: response.status, detail: String(answer?.detail ?? "The server refused") };
  state = answer;
  draw();
  return { ok: true };
}

/** Show the login state beside the title; a click opens the dialog. */
function draw() {
  document.body.dataset.role = state?.role ?? "";
  const text = state?.ended ? "login ended" : refused ? "not logged in" : state?.role === "viewer" ? "viewer (read-only)" : needsLogin() ? "private" : "";
  if (!chip) {
    chip = el("button", { type: "button", id: "login", cls: "small" });
    document.querySelector("header h1").after(chip);
    chip.addEventListener("click", async () => {
      const wasLockedOut = needsLogin();
      if (await askToLogIn() && wasLockedOut) location.reload();
    });
  }
  chip.hidden = !text;
  setText(chip, text);
}
