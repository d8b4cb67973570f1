// Several sessions chosen: downloaded as one zip file, or moved to the trash.

import * as api from "../common/api.js";
import { ask } from "../common/dialogs.js";
import { notice, quietly } from "../common/notices.js";
import { byId, bytes, el, setText } from "../common/text.js";

const ZIP_MOST = 1000; // as many as the server takes

const many = (count) => `${count} session${count === 1 ? "" : "s"}`;

export class Chosen {
  /**
   * @param {object} of
   * @param {HTMLInputElement} of.all the box that chooses all of `shown()`
   * @param {() => Session[]} of.shown
   * @param {(session: Session) => void} of.onSession as the list has them
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

  /** The box in a session's row. @param {Session} session */
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

  /** The box of a take. @param {Session[]} sessions */
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

  /** Those that are chosen and still listed. */
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
    setText(byId("chosen-text"), `${chosen.length} selected${left ? `, ${left} not sealed yet and not in a zip file` : ""}`);
    const zip = byId("chosen-zip", HTMLAnchorElement);
    const can = sealed.length > 0 && sealed.length <= ZIP_MOST;
    setText(zip, can ? `Download ${many(sealed.length)} as zip, ${bytes(size)}` : sealed.length ? `At most ${ZIP_MOST} in a zip file` : "Nothing to download");
    if (can) zip.href = api.zipAddress(sealed.map(({ id }) => id));
    else zip.removeAttribute("href");
  }

  async delete() {
    const chosen = this.sessions.filter(({ state }) => state === "sealed" || state === "pending");
    const left = this.sessions.length - chosen.length;
    if (!chosen.length) return notice("What is being recorded cannot be deleted: stop it first.", { bad: true });
    const sure = await ask(`Move ${many(chosen.length)} to the trash?`,
      `They can be restored until it is emptied.${left ? ` ${many(left)} that ${left === 1 ? "is" : "are"} being recorded stay${left === 1 ? "s" : ""}.` : ""}`,
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
      if (gone.length) notice(`${many(gone.length)} moved to the trash.`, { press: ["Undo", () => quietly(() => this.restore(gone))] });
    }
    return null;
  }

  async restore(ids) {
    for (const id of ids) this.onSession(await api.restoreSession(id));
  }
}
