// Selected sessions: download as one zip file, compare two, or move to the trash.

import * as api from "../common/api.js";
import { ask } from "../common/dialogs.js";
import { notice, quietly } from "../common/notices.js";
import { byId, bytes, el, setText } from "../common/text.js";
import { comparisonAddress } from "./row.js";

const ZIP_MAX = 1000; // limit of the server

export const many = (count) => `${count} session${count === 1 ? "" : "s"}`;

/** Selection of sessions in the list. */
export class Chosen {
  /**
   * @param {object} of
   * @param {HTMLInputElement} of.all box that selects all of `shown()`
   * @param {() => SessionView[]} of.shown
   * @param {(session: SessionView) => void} of.onSession updates the list
   * @param {(id: string) => void} of.onDeleted
   */
  constructor({ all, shown, onSession, onDeleted }) {
    this.ids = new Set();
    this.all = all;
    this.shown = shown;
    this.onSession = onSession;
    this.onDeleted = onDeleted;
    all.addEventListener("change", () => {
      this.ids = new Set(all.checked ? shown().map(({ id }) => id) : []);
      for (const box of /** @type {NodeListOf<HTMLInputElement>} */ (document.querySelectorAll("#sessions .c-pick input"))) box.checked = all.checked;
      this.draw();
    });
    byId("chosen-delete").addEventListener("click", () => quietly(() => this.delete()));
    byId("chosen-none").addEventListener("click", () => {
      all.checked = false;
      all.dispatchEvent(new Event("change"));
      all.focus();
    });
  }

  /** Make the box of a session's row. @param {SessionView} session */
  pick(session) {
    const box = el("input", { type: "checkbox", "data-part": "pick", "aria-label": `Select ${session.name || session.id}` });
    box.checked = this.ids.has(session.id);
    box.addEventListener("change", () => {
      if (box.checked) this.ids.add(session.id);
      else this.ids.delete(session.id);
      this.draw();
    });
    return box;
  }

  /** Make the box of a take. @param {SessionView[]} sessions */
  pickAll(sessions) {
    const box = el("input", { type: "checkbox", "data-part": "pick-take", "aria-label": `Select the take ${sessions[0].name}` });
    box.addEventListener("change", () => {
      for (const { id } of sessions) {
        /** @type {HTMLInputElement} */ (document.querySelector(`#sessions [data-session-id="${CSS.escape(id)}"] .c-pick input`)).checked = box.checked;
        if (box.checked) this.ids.add(id);
        else this.ids.delete(id);
      }
      this.draw();
    });
    return box;
  }

  /** Sessions that are selected and listed. */
  get sessions() {
    return this.shown().filter(({ id }) => this.ids.has(id));
  }

  draw() {
    const chosen = this.sessions;
    const listed = this.shown().length;
    this.all.checked = listed > 0 && chosen.length === listed;
    this.all.indeterminate = chosen.length > 0 && chosen.length < listed;
    for (const row of /** @type {NodeListOf<HTMLElement>} */ (document.querySelectorAll("#sessions .take"))) {
      const box = row.querySelector("input");
      const of = this.shown().filter(({ take }) => take === row.dataset.take);
      const count = of.filter(({ id }) => this.ids.has(id)).length;
      box.checked = count === of.length;
      box.indeterminate = count > 0 && count < of.length;
    }
    byId("chosen").hidden = !chosen.length;
    const sealed = chosen.filter(({ state }) => state === "sealed");
    const size = sealed.reduce((sum, session) => sum + (session.bytes ?? 0), 0);
    const left = chosen.length - sealed.length;
    setText(byId("chosen-text"), `${chosen.length} selected${left ? `, ${left} not sealed (not in the zip)` : ""}`);
    const zip = byId("chosen-zip", HTMLAnchorElement);
    const can = sealed.length > 0 && sealed.length <= ZIP_MAX;
    setText(zip, can ? `Download ${many(sealed.length)} as zip, ${bytes(size)}` : sealed.length ? `Zip: ${ZIP_MAX} sessions at most` : "No sealed session selected");
    if (can) zip.href = api.zipAddress(sealed.map(({ id }) => id));
    else zip.removeAttribute("href");
    const compare = byId("chosen-compare", HTMLAnchorElement);
    compare.hidden = sealed.length !== 2 || left > 0;
    if (!compare.hidden) compare.href = comparisonAddress(sealed[0], sealed[1]);
  }

  async delete() {
    const chosen = this.sessions.filter(({ state }) => state === "sealed" || state === "pending");
    const left = this.sessions.length - chosen.length;
    if (!chosen.length) return notice("a running recording cannot be deleted. Stop it first.", { bad: true });
    const sure = await ask(`Move ${many(chosen.length)} to the trash?`,
      `They can be restored until the trash is emptied.${left ? ` ${left} running recording${left === 1 ? " is" : "s are"} not deleted.` : ""}`,
      `Delete ${many(chosen.length)}`);
    if (!sure) return null;
    const gone = [];
    try {
      for (const session of chosen) {
        await api.deleteSession(session.id);
        gone.push(session.id);
        this.ids.delete(session.id);
        this.onDeleted(session.id);
      }
    } finally {
      this.draw();
      if (gone.length) notice(`${many(gone.length)} moved to the trash.`, { about: gone, press: ["Undo", () => quietly(() => this.restore(gone))] });
    }
    return null;
  }

  async restore(ids) {
    for (const id of ids) this.onSession(await api.restoreSession(id));
  }
}
