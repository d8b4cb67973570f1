// Tare, Record, Stop, Mark: buttons, fields and shortcuts.

import * as api from "./api.js";
import { notice } from "./notices.js";
import { byId, duration, localTime, setText } from "./text.js";

const UNDO_KEY = "foottile.undo"; // survives a reload, not the tab

export class Actions {
  /** `state` is the page's state; `onSession(session)` takes every session an answer brings. */
  constructor(state, onSession) {
    this.state = state;
    this.onSession = onSession;
    this.busy = new Set();
    for (const name of ["tare", "undo", "record", "stop", "mark"]) {
      byId(name).addEventListener("click", () => this.run(name));
    }
    byId("mark-label").addEventListener("keydown", (event) => {
      if (event.key === "Enter" && !event.isComposing) this.run("mark");
    });
    byId("session-name").addEventListener("keydown", (event) => {
      if (event.key === "Enter" && !event.isComposing) this.run("record");
    });
    document.addEventListener("keydown", (event) => this.shortcut(event));
  }

  shortcut(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || event.repeat) return;
    if (event.target.closest?.("input, textarea, select, dialog, [contenteditable]")) return;
    const name = { t: "tare", r: "record", s: "stop", m: "mark" }[event.key];
    if (!name) return;
    event.preventDefault();
    this.run(name);
  }

  /** Run an action once at a time, and say what came of it. */
  async run(name) {
    const button = byId(name);
    if (button.disabled || button.hidden || this.busy.has(name)) {
      if (name === "mark" && !this.session()) notice("Marks belong to a recording: press Record first.", { bad: true });
      return;
    }
    this.busy.add(name);
    button.setAttribute("aria-busy", "true");
    try {
      await this[name](this.state.node);
    } catch (error) {
      if (!(error instanceof api.Refusal)) throw error;
      notice(error.message, { bad: true });
    } finally {
      this.busy.delete(name);
      button.removeAttribute("aria-busy");
      this.draw();
    }
  }

  async tare(node) {
    const tare = await api.tareNow(node.node);
    this.undoable(tare.id);
    node.tare = tare; // do not wait a second for the node's message
    notice(`Tared ${node.node} from ${tare.frames} unloaded frames.`);
  }

  async undo(node) {
    const automatic = node.tare.source === "flight";
    await api.undoTare(node.node, node.tare.id);
    this.undoable(null);
    notice(automatic
      ? "Automatic tare undone: the one before it holds again, and no other comes until you press Tare."
      : "Tare undone: the one before it holds again.");
    byId("tare").focus();
  }

  async record(node) {
    const field = byId("session-name");
    const name = field.value.trim() || localTime(new Date());
    const session = await api.startSession(node.node, name);
    field.value = "";
    this.onSession(session);
    notice(`Recording “${session.name}”.`);
    this.draw();
    if (document.activeElement === document.body || document.activeElement === byId("record")) byId("stop").focus();
  }

  async stop() {
    const session = await api.stopSession(this.session().id);
    this.onSession(session);
    notice(session.state === "pending"
      ? `Stopped “${session.name}”. The node is away: the recording completes when it returns.`
      : `Stopped “${session.name}”.`);
    this.draw();
    if (document.activeElement === document.body) byId("record").focus();
  }

  async mark() {
    const field = byId("mark-label");
    const label = field.value.trim() || "mark";
    await api.markEvent(this.session().id, label);
    field.value = "";
    notice(`Marked “${label}”.`);
  }

  undoable(id) {
    try {
      if (id === null) sessionStorage.removeItem(UNDO_KEY);
      else sessionStorage.setItem(UNDO_KEY, id);
    } catch { /* private window: undo until reload */ }
    this.undoId = id;
  }

  /** The recording that runs on the chosen node, if any. */
  session() {
    for (const session of this.state.recordings.values()) if (session.node === this.state.node?.node) return session;
    return null;
  }

  draw() {
    const { node } = this.state;
    const session = this.session();
    byId("tare").disabled = byId("record").disabled = !node;
    byId("record").disabled ||= Boolean(session);
    byId("stop").disabled = byId("mark").disabled = !session;
    if (this.undoId === undefined) {
      try { this.undoId = sessionStorage.getItem(UNDO_KEY); } catch { this.undoId = null; }
    }
    const tare = node?.tare;
    const mine = this.undoId && tare?.id === this.undoId;
    byId("undo").hidden = !(tare && !tare.undone && (mine || tare.source === "flight"));
    byId("recording").hidden = !session;
    if (session) {
      const elapsedS = Math.max(0, (this.state.serverNowMs() - session.started_t_ns / 1e6) / 1000);
      setText(byId("recording-text"), `${duration(elapsedS)}, ${session.frames + (session.since ?? 0)} frames, “${session.name}”`);
    }
  }
}
