// Card of a node: live state, force, link quality, recording, warnings.

import { lossCounts } from "../common/losses.js";
import { quietly } from "../common/notices.js";
import { ReplacementWarning } from "../common/replacement.js";
import { loadModule } from "../common/request.js";
import { duration, el, localTime, number, perSecond, plain, roughly, setData, setText } from "../common/text.js";
import { drawContact, whyNot } from "../live/grf.js";
import { Warnings } from "../live/notes.js";
import { stateText } from "../sessions/state.js";
import { SmallFoot } from "./small_foot.js";
import { SmallTrace } from "./small_trace.js";

const FROZEN_AFTER_MS = 600;
const SHOWN_BACKLOG_S = 0.5; // less is in transit
const SLOW = 0.9;
const WARNINGS_MAX = 3;
const NODE_KEY = "foottile.node"; // node on the live page

/** Text of each vital of a node. @type {Record<string, (value: any) => string>} */
const VITALS = {
  cpu_celsius: (celsius) => `${celsius.toFixed(0)} °C`,
  load_per_core: (load) => `load ${(100 * load).toFixed(0)} %`,
  recording_left_s: (s) => `disk for ${roughly(s)}`,
  wifi_dbm: (dbm) => `Wi-Fi ${dbm.toFixed(0)} dBm`,
  is_clock_synchronised: (is) => (is ? "clock synchronised" : "clock not synchronised"),
};

/** Vitals in short, without unknown ones; whatever is bad is among the node's warnings. @param {Partial<Vitals>} vitals */
export const vitalsText = (vitals) => Object.keys(VITALS).filter((name) => (vitals[name] ?? null) !== null).map((name) => VITALS[name](vitals[name])).join(", ");

/** Card of a node. */
export class Card {
  constructor(name) {
    this.node = null;
    this.frame = null;
    this.frameMs = null;
    this.heartbeat = null;
    this.fresh = false;
    this.refused = ""; // failed action and its reason
    this.warnings = new Warnings();
    this.session = null; // latest session since this page was opened
    const link = el("a", { href: "/", text: name, title: "Live page of this node" });
    link.addEventListener("click", () => {
      try { localStorage.setItem(NODE_KEY, name); } catch { /* private window */ }
    });
    const part = (tag, cls) => el(tag, { cls });
    this.state = part("span", "state");
    this.bound = part("span", "bound");
    this.value = part("span", "value");
    this.unit = el("span", { cls: "unit", text: "N" });
    this.sigma = part("span", "sigma");
    this.contact = part("span", "contact");
    const canvas = el("canvas", { cls: "node-foot", role: "img", "aria-label": `Tiles of ${name} shaded by force, and the centre of pressure` });
    this.foot = new SmallFoot(canvas);
    const strip = el("canvas", { cls: "node-trace", role: "img", "aria-label": `Ground reaction force of ${name} over the last 10 seconds` });
    this.trace = new SmallTrace(strip, () => this.node.stream_id);
    const facts = el("dl", { cls: "node-facts" });
    this.facts = Object.fromEntries(["Frames/s", "Losses", "Backlog", "Tare", "Machine"].map((title) => {
      const value = el("dd");
      const row = el("div", {}, el("dt", { text: title, cls: title === "Losses" ? "unseen" : "" }), value);
      facts.append(row);
      return [title, { row, value }];
    }));
    this.calibration = el("button", { type: "button", cls: "small", text: "Calibration …", "aria-label": `Calibration of ${name}` });
    this.calibration.addEventListener("click", () => quietly(async () => {
      const { openCalibration } = await loadModule(() => import("../common/calibration.js"));
      await openCalibration(this.node);
    }));
    this.replacement = new ReplacementWarning();
    this.notes = part("ul", "node-notes");
    this.sessionLine = part("p", "node-session");
    this.element = el("li", { cls: "node", "data-node": name },
      el("div", { cls: "node-head" }, el("h2", {}, link), this.state),
      el("div", { cls: "node-grf" }, el("p", {}, this.bound, this.value, " ", this.unit), this.contact, this.sigma),
      canvas, strip, el("div", { cls: "node-more" }, facts, this.calibration, this.replacement.element, this.notes, this.sessionLine));
  }

  /** Store the node's description. */
  update(node) {
    if (this.node && this.node.stream_id !== node.stream_id) { // new stream
      this.frame = this.frameMs = this.heartbeat = null;
      this.warnings.clear();
      this.trace.clear();
    }
    this.node = node;
    this.fresh = true;
  }

  addFrame(frame) {
    this.frame = frame;
    this.frameMs = performance.now();
    this.warnings.addFrame(this.node, frame, this.frameMs);
    this.trace.add(this.node, frame, this.frameMs);
    this.fresh = true;
  }

  isLive(nowMs) {
    return this.frameMs !== null && nowMs - this.frameMs <= FROZEN_AFTER_MS;
  }

  recolour() {
    this.foot.recolour();
    this.trace.recolour();
    this.fresh = true;
  }

  /** Draw force, foot and trace of one frame, if there is a new one. */
  draw() {
    if (!this.fresh || !this.node) return;
    this.fresh = false;
    this.writeForce(this.node, this.frame);
    this.foot.draw(this.node, this.frame);
    this.trace.draw(performance.now());
  }

  writeForce(node, frame) {
    const grf = Number.isFinite(frame?.grf_n) ? frame.grf_n : null;
    const atLeast = grf === null && Number.isFinite(frame?.grf_lower_bound_n) ? Math.max(0, Math.floor(frame.grf_lower_bound_n * 10) / 10) : null;
    setText(this.bound, atLeast === null ? "" : "at least ");
    setText(this.value, number(grf ?? atLeast ?? NaN));
    setData(this.value, "value", plain(grf));
    this.unit.hidden = grf === null && atLeast === null;
    const assumed = node.calibration?.absolute_scale === "assumed" ? ", assumed scale" : "";
    setText(this.sigma, grf === null ? whyNot(node, frame)
      : Number.isFinite(frame.grf_sigma_n) ? `± ${number(1.96 * frame.grf_sigma_n)} N (95 %)${assumed}` : "");
    drawContact(this.contact, frame);
  }

  /** Write state, link quality, warnings and session; `linkOpen`: the server is connected. */
  write(nowMs, serverNowMs, linkOpen) {
    const { node, frame } = this;
    const live = linkOpen && this.isLive(nowMs);
    setData(this.element, "live", String(live));
    const [text, cls] = this.liveText(live, nowMs, serverNowMs, linkOpen);
    setText(this.state, text);
    if (this.state.className !== `state ${cls}`) this.state.className = `state ${cls}`;

    this.writeFacts(node, live);
    this.replacement.draw(node);
    this.writeNotes(this.warnings.list(node, frame, nowMs, serverNowMs));
    this.writeSession();
  }

  liveText(live, nowMs, serverNowMs, linkOpen) {
    if (live) return ["live", "live"];
    if (linkOpen && !this.node.connected) return ["offline", "away"];
    const sinceMs = this.frameMs !== null ? nowMs - this.frameMs
      : this.node.last_seen_t_ns ? serverNowMs - this.node.last_seen_t_ns / 1e6 : null;
    return [sinceMs === null ? "no data yet" : `no data for ${roughly(sinceMs / 1000)}`, "away"];
  }

  writeFacts(node, live) {
    const heartbeat = this.heartbeat ?? {};
    const fact = (title, text, bad, stale = !live) => {
      setText(this.facts[title].value, text);
      setData(this.facts[title].value, "bad", String(bad));
      setData(this.facts[title].value, "stale", String(stale));
    };
    const rateHz = live ? heartbeat.rate_hz ?? node.rate_hz : null;
    const of = rateHz !== null && rateHz <= node.nominal_rate_hz ? ` of ${perSecond(node.nominal_rate_hz)}` : "";
    const slow = rateHz !== null && rateHz < SLOW * node.nominal_rate_hz;
    fact("Frames/s", `${perSecond(rateHz ?? NaN)}${of}`, slow);
    const lost = heartbeat.lost_frames ?? node.lost_frames ?? 0;
    const missed = heartbeat.missed_slots ?? node.missed_slots ?? 0;
    fact("Losses", lossCounts(lost, missed), lost > 0 || slow);
    const backlog = heartbeat.backlog_frames ?? node.backlog_frames ?? 0;
    this.facts.Backlog.row.hidden = backlog < SHOWN_BACKLOG_S * (node.nominal_rate_hz || 400);
    this.facts.Tare.row.hidden = !node.tare || node.tare.undone;
    fact("Tare", node.tare ? localTime(new Date(node.tare.t_ns / 1e6)) : "", false, false);
    const machine = node.connected ? vitalsText(node.vitals ?? {}) : "";
    this.facts.Machine.row.hidden = !machine;
    fact("Machine", machine, false);
    fact("Backlog", `${backlog.toLocaleString("en-GB")} frames`, false);
  }

  /** @param {import("../live/notes.js").Note[]} all */
  writeNotes(all) {
    const shown = all.slice(0, WARNINGS_MAX).map(({ text }) => text);
    if (all.length > WARNINGS_MAX) shown.push(`and ${all.length - WARNINGS_MAX} more on its live page`);
    const key = JSON.stringify([this.refused, shown]);
    if (key === this.notesKey) return;
    this.notesKey = key;
    const items = shown.map((text) => el("li", { text }));
    if (this.refused) items.unshift(el("li", { cls: "refused", text: this.refused }));
    this.notes.replaceChildren(...items);
  }

  writeSession() {
    const { session } = this;
    const recording = session?.state === "recording";
    setData(this.element, "recording", String(recording));
    if (!session) return;
    const [short, long] = stateText(session);
    const key = JSON.stringify([session.id, session.name, short, long, recording ? Math.floor(session.duration_s) : session.frames, session.marker_count]);
    if (key === this.sessionKey) return;
    this.sessionKey = key;
    const markers = session.marker_count ? `, ${session.marker_count} marker${session.marker_count === 1 ? "" : "s"}` : "";
    const frames = `${session.frames.toLocaleString("en-GB")} frames`;
    const state = recording ? `${short}, ${duration(Math.floor(session.duration_s))}` : `${short}, ${frames}`;
    this.sessionLine.replaceChildren(
      el("a", { href: `/sessions/${encodeURIComponent(session.id)}`, text: session.name || session.id }), ` ${state}${markers}`,
      ...(long && !recording ? [el("span", { cls: "why", text: ` ${long}` })] : []));
  }
}
