// Questions that stop the page until they are answered: are you sure, and what to say of a session.

import { el } from "./text.js";

const ROWS = 4;

/** Resolves to true if the user agrees. @param {string} title @param {string} text @param {string} yes */
export async function ask(title, text, yes) {
  return await answered("ask", title, [el("p", { id: "ask-text", text })], el("button", { type: "submit", value: "ok", id: "ask-yes", text: yes }), { doubts: true });
}

/**
 * Resolves to what was changed of a session, or null.
 * @param {Session} session
 * @returns {Promise<Partial<Session> | null>}
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
    el("label", { text: "Tags, commas between " }, fields.tags), el("label", { text: "Notes " }, fields.notes),
  ];
  const save = el("button", { type: "submit", value: "ok", text: "Save" });
  if (!await answered("edit", "About this session", labels, save)) return null;
  const given = {
    name: fields.name.value.trim() || session.name, subject: fields.subject.value.trim(), notes: fields.notes.value,
    tags: fields.tags.value.split(",").map((tag) => tag.trim()).filter(Boolean),
  };
  const changed = Object.entries(given).filter(([part, value]) => JSON.stringify(value) !== JSON.stringify(session[part]));
  return changed.length ? Object.fromEntries(changed) : null;
}

/**
 * Made for this one answer: nothing of it is left on the page.
 * @param {string} name
 * @param {string} title
 * @param {HTMLElement[]} content
 * @param {HTMLButtonElement} yes
 * @param {{doubts?: boolean}} [how] doubts: Enter alone is no
 * @returns {Promise<boolean>}
 */
function answered(name, title, content, yes, { doubts = false } = {}) {
  const no = el("button", { type: "submit", value: "", formnovalidate: "", text: "Cancel", ...(doubts ? { autofocus: "" } : {}) });
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
