// Notices: results and refusals of actions.

import { Refusal } from "./request.js";
import { byId, el } from "./text.js";

const SHOWN_MS = 4000;
const WITH_BUTTON_MS = 10_000;
const NOTICES_MAX = 2;

/**
 * Show a notice. `press`: label and action of a button on it.
 * @param {string} text
 * @param {{bad?: boolean, press?: [string, () => unknown] | null, stays?: boolean, about?: string[]}} [how] `about`: ids, for `withdraw`
 */
export function notice(text, { bad = false, press = null, stays = bad, about = [] } = {}) {
  const box = byId("notices");
  const close = el("button", { type: "button", cls: "close", text: "×", "aria-label": "Dismiss" });
  const item = el("p", { cls: bad ? "notice bad" : "notice", "data-about": about.join(" "), "data-stays": stays }, el("span", { text: bad ? `Not done: ${text}` : text }));
  if (press) {
    const button = el("button", { type: "button", cls: "small", text: press[0] });
    button.addEventListener("click", () => { item.remove(); press[1](); });
    item.append(button);
  }
  item.append(close);
  close.addEventListener("click", () => item.remove());
  // A refusal stays until it is dismissed or replaced.
  for (const old of box.querySelectorAll(".bad")) old.remove();
  box.append(item);
  while (box.children.length > NOTICES_MAX) (box.querySelector('[data-stays="false"]:not(:last-child)') ?? box.firstElementChild).remove();
  if (!stays) setTimeout(() => item.remove(), press ? WITH_BUTTON_MS : SHOWN_MS);
}

const find = (id) => byId("notices").querySelector(`[data-about~="${CSS.escape(id)}"]`);

/** Return true while a notice about an id is shown. @param {string} id */
export const isShown = (id) => find(id) !== null;

/** Remove a notice about an id that no longer holds. @param {string} id */
export const withdraw = (id) => find(id)?.remove();

/** Show a refusal; rethrow any other error, for guard.js. @param {unknown} error */
export function showRefusal(error) {
  if (!(error instanceof Refusal)) throw error;
  notice(error.message, { bad: true });
}

/** Run an action; show a refusal as a notice. */
export async function quietly(action) {
  await Promise.resolve().then(action).catch(showRefusal);
}
