// Results and refusals of what the user did: short, announced politely, few at a time.

import { Refusal } from "./request.js";
import { byId, el } from "./text.js";

const GOOD_FOR_MS = 4000;
const PRESS_FOR_MS = 10_000;
const MOST = 2;

/**
 * Show a short text. `press`, the words of a button and what it does, is offered for as long as the notice stands.
 * @param {string} text
 * @param {{bad?: boolean, press?: [string, () => unknown] | null, stays?: boolean}} [how]
 */
export function notice(text, { bad = false, press = null, stays = bad } = {}) {
  const box = byId("notices");
  const close = el("button", { type: "button", cls: "close", text: "×", "aria-label": "Dismiss" });
  const item = el("p", { cls: bad ? "notice bad" : "notice" }, el("span", { text: bad ? `Not done: ${text}` : text }));
  if (press) {
    const button = el("button", { type: "button", cls: "small", text: press[0] });
    button.addEventListener("click", () => { item.remove(); press[1](); });
    item.append(button);
  }
  item.append(close);
  close.addEventListener("click", () => item.remove());
  // A refusal says what to do: it stays until it is dismissed or something newer is said.
  for (const old of box.querySelectorAll(".bad")) old.remove();
  box.append(item);
  while (box.children.length > MOST) box.firstElementChild.remove();
  if (!stays) setTimeout(() => item.remove(), press ? PRESS_FOR_MS : GOOD_FOR_MS);
}

/** Show a refusal. Any other error is a fault of this page: thrown on, to guard.js. @param {unknown} error */
export function showRefusal(error) {
  if (!(error instanceof Refusal)) throw error;
  notice(error.message, { bad: true });
}

/** Do something; a refusal is told, not thrown. */
export async function quietly(doing) {
  await Promise.resolve().then(doing).catch(showRefusal);
}
