// Record, marker and stop for all nodes: one request, with a result per node. Tare all: one request per node.

import * as api from "../common/api.js";
import { countLost, greatestShare, lossCounts, MISSED_SHARE_MAX, percentText } from "../common/losses.js";
import { notice, quietly, withdraw } from "../common/notices.js";
import { bindField, press } from "../common/press.js";
import { byId, duration, isShortcut, localTime, setData, setText } from "../common/text.js";
import { MarkerQueue } from "../live/markers.js";

const KEYS = { r: "record-all", m: "marker-all", s: "stop-all", t: "tare-all" };

/** Action bar of all nodes. */
export class Takes {
  /**
   * @param {object} page
   * @param {Map<string, SessionView>} page.recordings running recordings, by id
   * @param {() => string} page.cannotRecord reason, or ""
   * @param {() => number} page.serverNowMs
   * @param {(session: SessionView) => void} page.onSession receives the sessions of each response
   * @param {() => string[]} page.connected names of the nodes that are connected
   * @param {(what: string, failed: Object<string, string>) => void} page.onRefused receives a failed action and the reason per node
   */
  constructor(page) {
    this.page = page;
    this.markedNodes = 0; // nodes with the latest marker; 0 if it failed on one
    this.markers = new MarkerQueue(async (id, event) => {
      const take = await api.addTakeMarker(id, event);
      this.markedNodes = this.showFailures(take, "marker not set") ? take.sessions.length : 0;
    });
    this.actions = { "record-all": () => this.record(), "marker-all": () => this.setMarker(), "stop-all": () => this.stop(), "tare-all": () => this.tare() };
    for (const id of Object.keys(this.actions)) byId(id).addEventListener("click", () => this.run(id));
    bindField("take-name", () => this.run("record-all"));
    bindField("take-label", () => this.run("marker-all"));
    document.addEventListener("keydown", (event) => {
      if (event.repeat || !KEYS[event.key] || !isShortcut(event)) return;
      event.preventDefault();
      this.run(KEYS[event.key]);
    });
    const bar = byId("actions");
    new ResizeObserver(() => document.documentElement.style.setProperty("--bar", `${bar.offsetHeight}px`)).observe(bar);
  }

  /** Return the latest running take with its sessions, or null. */
  running() {
    const sessions = [...this.page.recordings.values()].filter((session) => session.take);
    if (!sessions.length) return null;
    const newest = sessions.reduce((a, b) => (b.started_t_ns > a.started_t_ns ? b : a));
    return { id: newest.take, name: newest.name, sessions: sessions.filter((session) => session.take === newest.take) };
  }

  /** Run an action, once at a time, and show its result. */
  async run(id) {
    await press(byId(id, HTMLButtonElement), "tare, record or set markers", this.actions[id], () => {
      if (id === "tare-all") notice(this.page.cannotRecord(), { bad: true });
      else if (id === "record-all") notice(this.running() ? "stop the running recording first." : this.page.cannotRecord(), { bad: true });
      else notice("no recording on all nodes is running. Press Record all first.", { bad: true });
    }).finally(() => this.draw());
  }

  async record() {
    const field = byId("take-name", HTMLInputElement);
    const name = field.value.trim() || localTime(new Date());
    const take = await api.startTake(name);
    field.value = "";
    this.page.onRefused("Not recorded", take.failed);
    if (this.showFailures(take, "not recorded")) notice(`Recording “${name}” on ${nodes(take.sessions.length)}.`);
    if (document.activeElement === document.body) byId("stop-all").focus();
  }

  async setMarker() {
    const pressedMs = this.page.serverNowMs();
    const field = byId("take-label", HTMLInputElement);
    const label = field.value.trim() || "marker";
    field.value = "";
    const sent = await this.markers.add([this.running()], label, pressedMs);
    if (sent.length && this.markedNodes) notice(`Marker “${label}” set on ${nodes(this.markedNodes)}.`);
  }

  async stop() {
    const take = await api.stopTake(this.running().id);
    this.page.onRefused("", {});
    if (!this.showFailures(take, "not stopped")) return;
    const pending = take.sessions.filter((session) => session.state === "pending").length;
    notice(`Stopped on ${nodes(take.sessions.length)}.${pending ? ` ${pending === 1 ? "One is" : `${pending} are`} sealed once the last frames arrive.` : ""}`);
    if (document.activeElement === document.body) byId("record-all").focus();
  }

  /** Tare each node by itself: a loaded one does not keep the others from it. */
  async tare() {
    const names = this.page.connected();
    notice(`Taring ${nodes(names.length)} …`, { about: ["taring"], stays: true });
    const answers = await Promise.allSettled(names.map((name) => api.tareNow(name)));
    withdraw("taring");
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
    const reasons = Object.entries(failed).map(([name, text]) => `${name} not tared: ${text}`).join(". ");
    if (reasons) notice(`${reasons}${tared.length ? ` ${nodes(tared.length)} tared.` : ""}`, { bad: true, press });
    else notice(`Tared ${nodes(tared.length)}.`, { press });
  }

  /** Store the sessions of a response and show on which nodes the action failed; return true if on none. */
  showFailures(take, what) {
    take.sessions.forEach(this.page.onSession);
    const failed = Object.entries(take.failed);
    if (failed.length) notice(failed.map(([node, reason]) => `${node} ${what}: ${reason}`).join(". "), { bad: true });
    return !failed.length;
  }

  draw() {
    const take = this.running();
    const reason = take ? "" : this.page.cannotRecord();
    byId("record-all", HTMLButtonElement).disabled = Boolean(take || reason);
    byId("tare-all", HTMLButtonElement).disabled = Boolean(this.page.cannotRecord());
    byId("stop-all", HTMLButtonElement).disabled = byId("marker-all", HTMLButtonElement).disabled = !take;
    setData(byId("actions"), "running", String(Boolean(take)));
    byId("record-all").classList.toggle("primary", !take);
    byId("stop-all").classList.toggle("primary", Boolean(take));
    byId("take-text").hidden = !take;
    if (take) {
      const longest = Math.max(...take.sessions.map((session) => session.duration_s));
      const sum = (countOf) => take.sessions.reduce((total, session) => total + countOf(session), 0);
      const lost = sum((session) => countLost(session.lost));
      const share = greatestShare(take.sessions);
      setText(byId("take-running"), `“${take.name}” on ${nodes(take.sessions.length)}, ${duration(Math.floor(longest))}, `);
      const counts = byId("take-losses");
      setText(counts, `${lossCounts(lost, sum((session) => session.missed_slots))}${share ? ` (${take.sessions.length > 1 ? "up to " : ""}${percentText(share)})` : ""}`);
      setData(counts, "bad", String(lost > 0 || share > MISSED_SHARE_MAX));
    }
    setText(byId("take-why"), take ? "" : reason ? `Cannot record: ${reason[0].toLowerCase()}${reason.slice(1)}` : "Not recording");
  }
}

const nodes = (count) => `${count} node${count === 1 ? "" : "s"}`;
