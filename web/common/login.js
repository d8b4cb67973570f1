// Getting in: a ticket or a token in the address, or a token typed in, becomes a cookie that no script can read.

import { parseAnswer, Refusal, sendRequest } from "./request.js";
import { el, setText } from "./text.js";

const PATH = "/api/v1/login";
const WHERE = "Ask who started the server: “foottile invite”, on that computer, shows an address and a code to scan "
  + "that let you in. Or type in the server's token.";
const ASKED = `Anyone may watch; to tare, record or change something you have to log in. ${WHERE}`;
const PRIVATE = `This server is private: to look you have to log in, too. ${WHERE}`;
const ENDED = `Your login has ended: the server was started again, or 12 hours are over. ${WHERE}`;
const VIEWER = `You came with a viewer's ticket: you may look, and not tare, record or change anything. ${WHERE}`;
const NOT_KEPT = "The server let this browser in, and the browser did not keep that: it blocks cookies of this address. "
  + "Allow them in its settings, or leave its private window; then load this page again.";
const WRONG = `That is not this server's token. ${WHERE}`;

/** What the server said last of who we are; null: it has not been reached. */
let state = null;
let refused = ""; // why a ticket or token in the address was not taken
let chip = null;

/** May this page offer what changes something? Without a login yes: it asks for one when it is needed. */
export const mayPress = () => state?.may !== "look";
/** Is nothing shown before somebody logs in? */
export const keptOut = () => Boolean(state?.private) && state.may === null;

/** Take a ticket or token out of the address, where it would be shared by accident, and go in with it. */
export async function enter() {
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
  if (state?.may) refused = ""; // in already: an address that is opened twice
  draw();
}

// An address that differs in this part only, opened in the same tab, loads nothing by itself.
addEventListener("hashchange", async () => {
  if (!/[#&](ticket|token)=/.test(location.hash)) return;
  await enter();
  if (!refused) location.reload();
});

/** Ask the server who we are; while it is away nothing changes. Resolves to whether it answered. */
export async function look() {
  return (await ask("GET")).ok;
}

/** Resolves when nobody is kept out any more: asks, and if that is cancelled waits until it is wanted. */
export async function letIn() {
  while (keptOut() && !await askToLogIn()) await new Promise((resolve) => chip.addEventListener("click", resolve, { once: true }));
}

let asking = null;
/** One dialog at a time, however many calls were refused. Resolves to true if somebody logged in. */
export function askToLogIn() {
  asking ??= dialogUntilIn().finally(() => { asking = null; });
  return asking;
}

async function dialogUntilIn() {
  if (!refused) await look(); // it may have ended since
  let why = refused ? asSentence(refused) : state?.ended ? ENDED : state?.may === "look" ? VIEWER : keptOut() ? PRIVATE : ASKED;
  refused = "";
  for (;;) {
    const token = await typed(why);
    if (!token) return false;
    const answer = await logIn({}, token);
    if (answer.ok) return true;
    why = answer.status === 401 ? WRONG : asSentence(answer.detail);
  }
}

function typed(why) {
  const field = el("input", { id: "token-field", type: "password", autocomplete: "off" });
  const dialog = el("dialog", { id: "token-dialog", "aria-labelledby": "token-title" },
    el("form", { method: "dialog" },
      el("h2", { id: "token-title", text: "Log in" }), el("p", { id: "token-why", text: why }),
      el("label", { text: "Token " }, field),
      el("p", { cls: "row" }, el("button", { type: "submit", value: "ok", text: "Log in" }),
        el("button", { type: "submit", value: "", text: "Cancel" }))));
  document.body.append(dialog);
  return new Promise((resolve) => {
    dialog.addEventListener("close", () => {
      dialog.remove();
      resolve(dialog.returnValue === "ok" ? field.value.trim() : "");
    }, { once: true });
    dialog.showModal();
  });
}

/** @param {string} text */
const asSentence = (text) => (/[.!?]$/.test(text) ? text : `${text}.`);

/** Log in, and check that the browser sends the cookie back. */
async function logIn(body, token) {
  const answer = await ask("POST", body, token);
  if (!answer.ok) return answer;
  const now = await ask("GET");
  return now.ok && state.may === null ? { ok: false, status: 0, detail: NOT_KEPT } : now;
}

/** Ask for, or change, who we are; resolves to what came of it. */
async function ask(method, body, token = null) {
  const headers = { Accept: "application/json" };
  if (body) headers["Content-Type"] = "application/json";
  if (token) headers.Authorization = `Bearer ${token}`;
  let response, answer;
  try {
    let text;
    ({ response, text } = await sendRequest(PATH, { method, headers, body: body && JSON.stringify(body) }));
    answer = parseAnswer(response, text);
  } catch (error) {
    if (!(error instanceof Refusal)) throw error;
    return { ok: false, status: error.status, detail: error.message };
  }
  if (!response.ok) return { ok: false, status: response.status, detail: String(answer?.detail ?? "The server refused") };
  state = answer;
  draw();
  return { ok: true };
}

/** What a person should know of their login stands beside the title; pressed, it asks for another one. */
function draw() {
  document.body.dataset.may = state?.may ?? "";
  const text = state?.ended ? "login ended" : refused ? "not logged in" : state?.may === "look" ? "viewer: looks only" : keptOut() ? "private" : "";
  if (!chip) {
    chip = el("button", { type: "button", id: "login", cls: "small" });
    document.querySelector("header h1").after(chip);
    chip.addEventListener("click", async () => {
      const sawNothing = keptOut();
      if (await askToLogIn() && sawNothing) location.reload();
    });
  }
  chip.hidden = !text;
  setText(chip, text);
}
