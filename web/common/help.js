// Help dialog of a page: opened by `?` or its button.

import { byId, el, isShortcut } from "./text.js";

/** Bind key and button of the help. @param {string} [text] last paragraph, shared by several pages */
export function helpWithKeys(text) {
  const dialog = byId("help-dialog", HTMLDialogElement);
  if (text) dialog.querySelector(".row").before(el("p", { text }));
  const open = () => {
    if (dialog.open) return;
    dialog.showModal();
    dialog.scrollTop = 0; // the focus on Close would hide the heading
  };
  byId("help").addEventListener("click", open);
  document.addEventListener("keydown", (event) => {
    if (event.key !== "?" || !isShortcut(event)) return;
    event.preventDefault();
    open();
  });
}
