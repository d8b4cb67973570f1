// Results and refusals of what the user did: short, announced politely, few at a time.

import { byId, el } from "./text.js";

const GOOD_FOR_MS = 4000;
const MOST = 2;

export function notice(text, { bad = false } = {}) {
  const box = byId("notices");
  const close = el("button", { type: "button", cls: "close", text: "×", "aria-label": "Dismiss" });
  const item = el("p", { cls: bad ? "notice bad" : "notice" }, el("span", { text: bad ? `Not done: ${text}` : text }), close);
  close.addEventListener("click", () => item.remove());
  // A refusal says what to do: it stays until it is dismissed or something newer is said.
  for (const old of box.querySelectorAll(".bad")) old.remove();
  box.append(item);
  while (box.children.length > MOST) box.firstElementChild.remove();
  if (!bad) setTimeout(() => item.remove(), GOOD_FOR_MS);
}
