// Questions that stop the page until they are answered: are you sure, and what to say of a session.

import { byId } from "./text.js";

/** Resolves to true if the user agrees. */
export function ask(title, text, yes) {
  const dialog = byId("ask-dialog");
  byId("ask-title").textContent = title;
  byId("ask-text").textContent = text;
  byId("ask-yes").textContent = yes;
  return closed(dialog);
}

/** Resolves to what was changed of a session, or null. */
export async function edit(session) {
  const field = (name) => byId(`edit-${name}`);
  for (const name of ["name", "subject", "notes"]) field(name).value = session[name] ?? "";
  field("tags").value = (session.tags ?? []).join(", ");
  if (!await closed(byId("edit-dialog"))) return null;
  const tags = field("tags").value.split(",").map((tag) => tag.trim()).filter(Boolean);
  const given = {
    name: field("name").value.trim() || session.name,
    subject: field("subject").value.trim(), notes: field("notes").value, tags,
  };
  const changed = Object.entries(given).filter(([name, value]) => JSON.stringify(value) !== JSON.stringify(session[name] ?? ""));
  return changed.length ? Object.fromEntries(changed) : null;
}

function closed(dialog) {
  dialog.returnValue = "";
  return new Promise((resolve) => {
    dialog.addEventListener("close", () => resolve(dialog.returnValue === "ok"), { once: true });
    dialog.showModal();
  });
}
