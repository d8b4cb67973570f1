// Action bar: Tare, Record, Stop, Marker; fields, shortcuts and running recordings.

import * as api from "../common/api.js";
import { countLost, missedText } from "../common/losses.js";
import { notice } from "../common/notices.js";
import { bindField, press } from "../common/press.js";
import { byId, duration, el, isShortcut, localTime, setData, setText } from "../common/text.js";

const UNDO_KEY = "foottile.undo"; // survives a reload, not the tab
const DOUBLE_TAP_MS = 1000; // a second press of Record or Stop within it is one press

const WHAT = "tare, record or set markers";

/** Focus a button that replaced another one, unless something else has the focus. */
function moveFocus(from, to) {
  const { activeElement } = document;
  if (activeElement === document.body || activeElement === byId(from)) byId(to).focus();
}

/** Action bar of the live page. */
export class Actions {
  /**
   * `state` is the page's state; `markers` queues markers until the server has stored them;
   * `onSession(session)` receives the session of each response.
   */
  constructor(state, markers, onSession) {
    this.state = state;
    this.markers = markers;
    this.onSession = onSession;
    this.recordedMs = -Infinity; // latest start, by performance.now()
    this.drawnNode = undefined;
    this.swappedMs = -Infinity; // Stop has replaced Record, or Record Stop
    this.rows = new Map(); // session id -> row
    for (const name of ["tare", "undo", "marker"]) byId(name).addEventListener("click", () => this.run(name));
    // One place for both: the second tap of a double tap meets the other button.
    for (const name of ["record", "stop"]) {
      byId(name).addEventListener("click", () => { if (performance.now() - this.swappedMs >= DOUBLE_TAP_MS) this.run(name); });
    }
    byId("another").addEventListener("click", () => this.run("record"));
    bindField("marker-label", () => this.run("marker"));
    bindField("session-name", () => this.run("record"));
    document.addEventListener("keydown", (event) => this.shortcut(event));
    const bar = byId("actions");
    byId("fields").addEventListener("click", () => {
      const open = bar.dataset.fields !== "true";
      bar.dataset.fields = String(open);
      byId("fields").setAttribute("aria-expanded", String(open));
    });
    new ResizeObserver(() => document.documentElement.style.setProperty("--bar", `${bar.offsetHeight}px`)).observe(bar);
  }

  /** Run the action of a key. */
  shortcut(event) {
    const name = { t: "tare", r: "record", s: "stop", m: "marker", p: "pause" }[event.key];
    if (!name || event.repeat || !isShortcut(event)) return;
    event.preventDefault();
    if (this[name]) this.run(name);
    else byId(name).click(); // button of another panel
  }

  /** Run an action, once at a time, and show its result. */
  async run(name) {
    await press(byId(name, HTMLButtonElement), WHAT, () => this[name](this.state.node), () => {
      if (name === "marker" && !this.running().length) notice("no recording is running. Press Record first.", { bad: true });
      else if (["record", "tare"].includes(name) && this.state.cannotRecord) notice(this.state.cannotRecord, { bad: true });
    }).finally(() => this.draw());
  }

  async tare(node) {
    const tare = await api.tareNow(node.node);
    this.setUndo(tare.id);
    node.tare = tare; // before the node's next message
    notice(`Tared ${node.node} from ${tare.frames} unloaded frames.`);
  }

  async undo(node) {
    await api.undoTare(node.node, node.tare.id);
    this.setUndo(null);
    const paused = node.auto_tare === "off" ? "" : " Automatic tare is paused until you press Tare.";
    notice(`Tare undone: previous tare restored.${paused}`);
    byId("tare").focus();
  }

  async record(node) {
    if (performance.now() - this.recordedMs < DOUBLE_TAP_MS) return;
    const field = byId("session-name", HTMLInputElement);
    const name = field.value.trim() || localTime(new Date());
    const session = await api.startSession(node.node, name);
    this.recordedMs = performance.now();
    field.value = "";
    this.onSession(session);
    notice(`Recording “${session.name}”.`);
    this.draw();
    moveFocus("record", "stop");
  }

  /** Stop recordings; by default all of the selected node. */
  async stop(_node, ids = this.running().map(({ id }) => id)) {
    const sessions = [];
    for (const id of ids) {
      sessions.push(await api.stopSession(id));
      this.onSession(sessions.at(-1));
    }
    const [{ name }] = sessions;
    const pending = sessions.filter(({ state }) => state === "pending").length;
    notice(sessions.length > 1 ? `Stopped ${sessions.length} recordings.${pending ? " They are sealed once their last frames arrive." : ""}`
      : `Stopped “${name}”.${pending ? " It is sealed once its last frames arrive." : ""}`);
    this.draw();
    moveFocus("stop", "record");
  }

  async marker() {
    const pressedMs = this.state.serverNowMs();
    const field = byId("marker-label", HTMLInputElement);
    const label = field.value.trim() || "marker";
    field.value = "";
    const sent = await this.markers.add(this.running(), label, pressedMs);
    if (sent.length) notice(`Marker “${label}” set.`);
  }

  /** Store the tare that this page may undo; null: none. */
  setUndo(id) {
    try {
      if (id === null) sessionStorage.removeItem(UNDO_KEY);
      else sessionStorage.setItem(UNDO_KEY, id);
    } catch { /* private window: undo until reload */ }
    this.undoId = id;
  }

  /** Return the running recordings of the selected node, newest first. */
  running() {
    const all = [...this.state.recordings.values()].filter((session) => session.node === this.state.node?.node);
    return all.sort((a, b) => b.started_t_ns - a.started_t_ns);
  }

  draw() {
    const { node } = this.state;
    const running = this.running();
    const reason = this.state.cannotRecord;
    for (const name of ["tare", "record", "another"]) byId(name, HTMLButtonElement).disabled = !node || Boolean(reason);
    const box = byId("cannot-record");
    box.hidden = !reason;
    setText(box, reason ? `Cannot record or tare: ${reason[0].toLowerCase()}${reason.slice(1)}` : "");
    byId("stop", HTMLButtonElement).disabled = byId("marker", HTMLButtonElement).disabled = !running.length;
    setText(byId("stop-text"), running.length > 1 ? `Stop all ${running.length}` : "Stop");
    if (this.undoId === undefined) {
      try { this.undoId = sessionStorage.getItem(UNDO_KEY); } catch { this.undoId = null; }
    }
    const tare = node?.tare;
    const isOwn = this.undoId && tare?.id === this.undoId;
    const undo = byId("undo", HTMLButtonElement);
    const whyNot = !tare || tare.undone ? "No tare to undo" : isOwn || tare.source === "flight" ? "" : "Only automatic tares, and those of this page, can be undone";
    if (undo.title !== whyNot) undo.title = whyNot;
    undo.disabled = Boolean(whyNot);
    this.drawRecordings(running);
  }

  drawRecordings(running) {
    const box = byId("recordings");
    box.hidden = !running.length;
    byId("last-session").hidden = Boolean(running.length || this.state.cannotRecord);
    const isRunning = String(Boolean(running.length));
    const node = this.state.node?.node;
    // A page that has just opened, or shows another node, has swapped nothing under a finger.
    if (byId("actions").dataset.running !== isRunning && node && node === this.drawnNode) this.swappedMs = performance.now();
    this.drawnNode = node;
    setData(byId("actions"), "running", isRunning);
    for (const name of ["record", "stop"]) byId(name).setAttribute("aria-disabled", String(performance.now() - this.swappedMs < DOUBLE_TAP_MS));
    box.dataset.several = String(running.length > 1);
    const rows = new Map(running.map((session) => [session.id, this.rows.get(session.id) ?? this.row(session)]));
    this.rows = rows;
    const shown = [...rows.values()];
    if (shown.length !== box.children.length || shown.some((row, i) => row !== box.children[i])) box.replaceChildren(...shown);
    for (const session of running) {
      const elapsedS = Math.max(0, (this.state.serverNowMs() - session.started_t_ns / 1e6) / 1000);
      const lost = countLost(session.lost);
      const row = rows.get(session.id);
      setText(row.querySelector(".recording-name"), `“${session.name}”`);
      setText(row.querySelector(".recording-time"), duration(elapsedS));
      const markers = session.marker_count; // edges of a sync line, too
      const marked = markers ? `, ${markers} marker${markers === 1 ? "" : "s"}` : "";
      setText(row.querySelector(".recording-frames"), `${session.frames.toLocaleString("en-GB")} frames${marked}`);
      const losses = row.querySelector(".recording-lost");
      setText(losses, [`${lost.toLocaleString("en-GB")} lost`, missedText(session)].filter(Boolean).join(", "));
      setData(losses, "bad", String(lost > 0));
    }
  }

  /** Make the row of a recording, with its own Stop button. */
  row(session) {
    const stop = el("button", { type: "button", cls: "small", text: "Stop", "aria-label": `Stop ${session.name}` });
    stop.addEventListener("click", () => press(stop, WHAT, () => this.stop(null, [session.id])));
    return el("li", { "data-session-id": session.id },
      el("span", { cls: "rec-dot", "aria-hidden": "true" }), el("span", { cls: "unseen", text: "Recording: " }),
      el("span", { cls: "recording-text" }, el("strong", { cls: "recording-name" }), " ", el("strong", { cls: "recording-time" }), " ",
        el("span", { cls: "recording-frames" }), " ", el("span", { cls: "recording-lost" })), stop);
  }
}
