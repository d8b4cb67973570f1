// Presses of buttons, and keys of text fields, of an action bar.

import { isOperator } from "./login.js";
import { notice, quietly } from "./notices.js";
import { byId } from "./text.js";

/**
 * Run the action of a button for an operator, once at a time, and show its refusal.
 * @param {HTMLButtonElement} button
 * @param {string} what the actions of the bar, for viewers: "record trials"
 * @param {() => unknown} act
 * @param {() => unknown} [explain] called instead while the button is disabled or busy
 */
export async function press(button, what, act, explain = () => {}) {
  if (!isOperator()) return notice(`viewers cannot ${what}. To log in as operator, press “viewer” beside the title.`, { bad: true });
  if (button.disabled || button.hasAttribute("aria-busy")) return explain();
  button.setAttribute("aria-busy", "true");
  return quietly(act).finally(() => button.removeAttribute("aria-busy"));
}

/** Bind keys of a text field: Enter runs the action, Escape clears; both leave it, so that shortcuts work again. */
export function bindField(id, run) {
  const field = byId(id, HTMLInputElement);
  field.addEventListener("keydown", (event) => {
    if (event.isComposing || !["Enter", "Escape"].includes(event.key)) return;
    if (event.key === "Escape") field.value = "";
    field.blur();
    if (event.key === "Enter") run();
  });
}
