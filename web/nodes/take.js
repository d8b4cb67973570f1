// Record, mark and stop all: one request to the server, which answers for each node. Tare all: one request a node.

import * as api from "../common/api.js";
import { mayPress } from "../common/login.js";
import { notice, quietly, showRefusal } from "../common/notices.js";
import { byId, duration, isInside, localTime, setData, setText } from "../common/text.js";
import { Marks } from "../live/marks.js";

const KEYS = { r: "record-all", m: "mark-all", s: "stop-all", t: "tare-all" };

export class Takes {
  /**
   * @param {object} page
   * @param {Map<string, Session>} page.recordings sessions that are being recorded, by id
   * @param {() => string} page.cannotRecord why not now, or nothing
   * @param {() => number} page.serverNowMs
   * @param {(session: Session) => void} page.onSession takes every session an answer brings
   * @param {() => string[]} page.connected names of the nodes that are connected
   * @param {(what: string, failed: Object<string, string>) => void} page.onRefused takes what was not done on which nodes, and why
   */
  constructor(page) {
    this.page = page;
    this.busy = new Set();
    this.markedOn = 0; // nodes, of the newest mark; 0 if it failed on one
    this.marks = new Marks(async (id, event) => {
      const take = await api.markTake(id, event);
      this.markedOn = this.told(take, "not marked") ? take.sessions.length : 0;
    });
    this.does = { "record-all": () => this.record(), "mark-all": () => this.mark(), "stop-all": () => this.stop(), "tare-all": () => this.tare() };
    for (const id of Object.keys(this.does)) byId(id).addEventListener("click", () => this.run(id));
    for (const [field, id] of [["take-name", "record-all"], ["take-label", "mark-all"]]) {
      const input = byId(field, HTMLInputElement);
      input.addEventListener("keydown", (event) => {
        if (event.isComposing || !["Enter", "Escape"].includes(event.key)) return;
        if (event.key === "Escape") input.value = "";
        input.blur();
        if (event.key === "Enter") this.run(id);
      });
    }
    document.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey || event.repeat) return;
      if (isInside(event, "input, dialog[open]") || !KEYS[event.key]) return;
      event.preventDefault();
      this.run(KEYS[event.key]);
    });
    const bar = byId("actions");
    new ResizeObserver(() => document.documentElement.style.setProperty("--bar", `${bar.offsetHeight}px`)).observe(bar);
  }

  /** The newest take of which something is being recorded: its id and these sessions; or null. */
  running() {
    const taken = [...this.page.recordings.values()].filter((session) => session.take);
    if (!taken.length) return null;
    const newest = taken.reduce((a, b) => (b.started_t_ns > a.started_t_ns ? b : a));
    return { id: newest.take, name: newest.name, sessions: taken.filter((session) => session.take === newest.take) };
  }

  /** Do something once at a time, and say what came of it. */
  async run(id) {
    const button = byId(id, HTMLButtonElement);
    if (!mayPress()) {
      notice("this login may look, and not press. “viewer”, beside the title, says more.", { bad: true });
      return;
    }
    if (button.disabled || this.busy.has(id)) {
      if (id === "tare-all") notice(this.page.cannotRecord(), { bad: true });
      else if (id === "record-all") notice(this.running() ? "Stop what is being recorded first." : this.page.cannotRecord(), { bad: true });
      else notice("Nothing is being recorded on all nodes: press Record all first.", { bad: true });
      return;
    }
    this.busy.add(id);
    button.setAttribute("aria-busy", "true");
    try {
      await this.does[id]();
    } catch (error) {
      showRefusal(error);
    } finally {
      this.busy.delete(id);
      button.removeAttribute("aria-busy");
      this.draw();
    }
  }

  async record() {
    const field = byId("take-name", HTMLInputElement);
    const name = field.value.trim() || localTime(new Date());
    const take = await api.startTake(name);
    field.value = "";
    this.page.onRefused("Not recorded", take.failed);
    if (this.told(take, "not recorded")) notice(`Recording “${name}” on ${nodes(take.sessions.length)}.`);
    if (document.activeElement === document.body) byId("stop-all").focus();
  }

  async mark() {
    const pressedMs = this.page.serverNowMs();
    const field = byId("take-label", HTMLInputElement);
    const label = field.value.trim() || "mark";
    field.value = "";
    const made = await this.marks.add([this.running()], label, pressedMs);
    if (made.length && this.markedOn) notice(`Marked “${label}” on ${nodes(this.markedOn)}.`);
  }

  async stop() {
    const take = await api.stopTake(this.running().id);
    this.page.onRefused("", {}); // what was said of this take is over
    if (!this.told(take, "not stopped")) return;
    const open = take.sessions.filter((session) => session.state === "pending").length;
    notice(`Stopped on ${nodes(take.sessions.length)}.${open ? ` ${open === 1 ? "One completes" : `${open} complete`} when the last frames have come.` : ""}`);
    if (document.activeElement === document.body) byId("record-all").focus();
  }

  /** Each node by itself: one that is loaded is refused, and the others are tared. */
  async tare() {
    const names = this.page.connected();
    const answers = await Promise.allSettled(names.map((name) => api.tareNow(name)));
    const tared = names.flatMap((name, i) => (answers[i].status === "fulfilled" ? [{ name, id: answers[i].value.id }] : []));
    const failed = {};
    answers.forEach((answer, i) => {
      if (answer.status === "fulfilled") return;
      if (!(answer.reason instanceof api.Refusal)) throw answer.reason;
      failed[names[i]] = answer.reason.message;
    });
    this.page.onRefused("Not tared", failed);
    const undo = () => quietly(async () => {
      for (const { name, id } of tared) await api.undoTare(name, id);
      notice(`Tare undone on ${nodes(tared.length)}.`);
    });
    const press = /** @type {[string, () => unknown] | null} */ (tared.length ? ["Undo", undo] : null);
    const why = Object.entries(failed).map(([name, text]) => `${name} is not tared: ${text}`).join(". ");
    if (why) notice(`${why}${tared.length ? ` ${nodes(tared.length)} tared.` : ""}`, { bad: true, press });
    else notice(`Tared ${nodes(tared.length)}.`, { press });
  }

  /** Take over what an answer brings; says where it was not done. Returns whether it was done everywhere. */
  told(take, what) {
    take.sessions.forEach(this.page.onSession);
    const failed = Object.entries(take.failed);
    if (failed.length) notice(`${failed.map(([node, why]) => `${node} is ${what}: ${why}`).join(". ")}`, { bad: true });
    return !failed.length;
  }

  draw() {
    const take = this.running();
    const why = take ? "" : this.page.cannotRecord();
    byId("record-all", HTMLButtonElement).disabled = Boolean(take || why);
    byId("tare-all", HTMLButtonElement).disabled = Boolean(this.page.cannotRecord());
    byId("stop-all", HTMLButtonElement).disabled = byId("mark-all", HTMLButtonElement).disabled = !take;
    setData(byId("actions"), "running", String(Boolean(take)));
    byId("record-all").classList.toggle("primary", !take);
    byId("stop-all").classList.toggle("primary", Boolean(take));
    byId("take-text").hidden = !take;
    if (take) {
      const longest = Math.max(...take.sessions.map((session) => session.duration_s));
      const lost = take.sessions.flatMap((session) => Object.values(session.lost ?? {})).reduce((sum, count) => sum + count, 0);
      setText(byId("take-running"), `“${take.name}” on ${nodes(take.sessions.length)}, ${duration(Math.floor(longest))}, ${lost.toLocaleString("en-GB")} frames lost`);
    }
    setText(byId("take-why"), take ? "" : why ? `Record all waits: ${why[0].toLowerCase()}${why.slice(1)}` : "Not recording");
  }
}

const nodes = (count) => `${count} node${count === 1 ? "" : "s"}`;
