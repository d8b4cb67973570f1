// Trash: deleted sessions, to restore or to delete permanently.

import * as api from "../common/api.js";
import { ask } from "../common/dialogs.js";
import { notice, quietly, withdraw } from "../common/notices.js";
import { byId, bytes, el, localTime, setText } from "../common/text.js";
import { many } from "./chosen.js";

/** List of deleted sessions. */
export class Trash {
  /** `onRestored(session)` receives a restored session, `onCount(count)` the number of deleted ones. */
  constructor(onRestored, onCount) {
    this.onRestored = onRestored;
    this.onCount = onCount;
    /** @type {SessionView[]} */
    this.items = [];
    this.requests = this.answered = 0;
    byId("trash-empty").addEventListener("click", () => this.empty());
  }

  /** Follow a listed session: one that is in the trash, or may be in a list on its way, has been restored. */
  follow({ id }) {
    if (this.answered !== this.requests || this.items.some((one) => one.id === id)) this.load();
  }

  async load() {
    const number = ++this.requests;
    await quietly(async () => {
      const { items } = await api.listTrash();
      if (number !== this.requests) return;
      this.items = items;
      byId("trash").replaceChildren(...items.map((session) => this.row(session)));
      byId("trash-empty").hidden = !items.length;
      setText(byId("trash-legend"), items.length ? `${many(items.length)}, can be restored` : "empty");
      this.onCount(items.length);
    });
    if (number === this.requests) this.answered = number;
  }

  /** @param {SessionView} session */
  row(session) {
    const button = el("button", { type: "button", cls: "small", text: "Restore", "aria-label": `Restore ${session.name}` });
    button.addEventListener("click", () => this.restore(session));
    const facts = [localTime(new Date(session.started_t_ns / 1e6)), `${session.frames.toLocaleString("en-GB")} frames`];
    if (session.state === "pending") facts.push("pending");
    return el("li", { "data-session-id": session.id }, button, el("strong", { text: session.name }), el("span", { text: facts.join(", ") }));
  }

  /** @param {SessionView} session */
  restore(session) {
    return quietly(async () => {
      const restored = await api.restoreSession(session.id);
      withdraw(session.id); // here, since messages of the live socket may be of before the deletion
      this.onRestored(restored); // loads the trash again, see `follow`
      notice(`Restored “${restored.name}”.`);
    });
  }

  async empty() {
    const what = many(this.items.length);
    if (!await ask("Empty the trash?", `${what} will be deleted permanently.`, `Delete ${what}`)) return;
    await quietly(async () => {
      const emptied = await api.emptyTrash();
      notice(`Deleted ${many(emptied.sessions)}, ${bytes(emptied.bytes)} freed.`);
      await this.load();
    });
  }
}
