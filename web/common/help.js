// Help dialog of a page: opened by `?` or its button.

import { byId, isInside } from "./text.js";

/** Bind key and button of the help. */
export function helpWithKeys() {
  const dialog = byId("help-dialog", HTMLDialogElement);
  const open = () => { if (!dialog.open) dialog.showModal(); };
  byId("help").addEventListener("click", open);
  document.addEventListener("keydown", (event) => {
    if (event.key !== "?" || event.ctrlKey || event.metaKey || event.altKey || isInside(event, "input, textarea, select, dialog[open]")) return;
    event.preventDefault();
    open();
  });
}
