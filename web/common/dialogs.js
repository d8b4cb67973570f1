// Modal dialogs: confirm, and edit a session.

import { el } from "./text.js";

const ROWS = 4;

/** Ask for confirmation; resolve to true if confirmed. @param {string} title @param {string} text @param {string} yes */
export async function ask(title, text, yes) {
  return await showDialog("ask", title, [el("p", { id: "ask-text", text })], el("button", { type: "submit", value: "ok", id: "ask-yes", text: yes }), { isRisky: true });
}

/**
 * Edit a session; resolve to the changes, or null.
 * @param {SessionView} session
 * @returns {Promise<Partial<SessionView> | null>}
 */
export async function edit(session) {
  const line = (part, maxlength) => el("input", { id: `edit-${part}`, type: "text", maxlength, autocomplete: "off" });
  const fields = { name: line("name", 200), subject: line("subject", 200), tags: line("tags", 2000), notes: el("textarea", { id: "edit-notes", rows: ROWS, maxlength: 10_000 }) };
  fields.name.value = session.name;
  fields.subject.value = session.subject;
  fields.tags.value = session.tags.join(", ");
  fields.notes.value = session.notes;
  const labels = [
    el("label", { text: "Name " }, fields.name), el("label", { text: "Subject " }, fields.subject),
    el("label", { text: "Tags (comma-separated) " }, fields.tags), el("label", { text: "Notes " }, fields.notes),
  ];
  const save = el("button", { type: "submit", value: "ok", text: "Save" });
  if (!await showDialog("edit", "Edit session", labels, save)) return null;
  const entered = {
    name: fields.name.value.trim() || session.name, subject: fields.subject.value.trim(), notes: fields.notes.value,
    tags: fields.tags.value.split(",").map((tag) => tag.trim()).filter(Boolean),
  };
  const changed = Object.entries(entered).filter(([part, value]) => JSON.stringify(value) !== JSON.stringify(session[part]));
  return changed.length ? Object.fromEntries(changed) : null;
}

/**
 * Show a dialog once and remove it; resolve to true if confirmed.
 * @param {string} name
 * @param {string} title
 * @param {HTMLElement[]} content
 * @param {HTMLButtonElement} yes
 * @param {{isRisky?: boolean}} [how] isRisky: Enter cancels
 * @returns {Promise<boolean>}
 */
export async function showDialog(name, title, content, yes, { isRisky = false } = {}) {
  const no = el("button", { type: "submit", value: "", formnovalidate: "", text: "Cancel", ...(isRisky ? { autofocus: "" } : {}) });
  const dialog = el("dialog", { id: `${name}-dialog`, "aria-labelledby": `${name}-title` },
    el("form", { method: "dialog" },
      el("h2", { id: `${name}-title`, text: title }), ...content, el("p", { cls: "row" }, yes, " ", no)));
  document.body.append(dialog);
  return new Promise((resolve) => {
    dialog.addEventListener("close", () => {
      dialog.remove();
      resolve(dialog.returnValue === "ok");
    }, { once: true });
    dialog.showModal();
  });
}
