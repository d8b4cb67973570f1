// The help of the page: `?` opens it, so does its button.

import { byId } from "../common/text.js";

export function helpWithKeys() {
  const dialog = byId("help-dialog");
  byId("help").addEventListener("click", () => { if (!dialog.open) dialog.showModal(); });
}
