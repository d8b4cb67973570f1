// Warnings about the values on display. A flag is held for some seconds, so that it can be read.

import { ESTIMATE, FRAME, TILE } from "../common/flags.js";
import { lossTexts } from "../common/losses.js";
import { byId, el, localTime, number, roughly, setData, setText, TARE_SOURCES } from "../common/text.js";
import { helpOf, whyOf } from "./why.js";

const HOLD_MS = 3000;
const FIRST_MS = 3000; // a warning this soon after opening may be older

/** @typedef {{key: string, id: string, text: string}} Note `key`: reason and help; `id`: same note, other text */

// A chip has an outlier now and then: this flag counts only if it stays.
const BELOW_RANGE = "A tile is below its calibrated range: lift the foot, press Tare.";
const SETTLE_MESSAGES = 15;
/** @type {[bit: number, key: string, text: string][]} */
const FROM_ESTIMATE = [
  [ESTIMATE.TILE_MISSING, "tile_missing", "Tile missing: force is a lower bound, no COP."],
  [ESTIMATE.STUCK, "stuck", "A tile repeats one reading: its force is unknown. Unplug and replug it."],
  [ESTIMATE.BASELINE_LOST, "baseline_lost", "Zero of a tile has dropped: force is less certain. Lift the foot, press Tare; if it recurs, the dome may leak."],
  [ESTIMATE.AFTER_SATURATION, "after_saturation", "Force is less certain: a tile was saturated or not read just before."],
  [ESTIMATE.HISTORY_UNKNOWN, "history_unknown", "Force is less certain: loads before the first frame are not known."],
  [ESTIMATE.OVER_RATED, "over_rated", "Above the chip's rated range, within the calibration."],
];
/** @type {[bit: number, key: string, text: string][]} */
const FROM_FRAME = [
  [FRAME.BUS_FAULT, "bus_fault", "Bus fault: the node cannot read all tiles. Check cable and supply."],
  [FRAME.OVERRUN, "overrun", "The node is late: some frames are not sampled."],
];

/** Current warnings of a node and its frames, each held long enough to be read. */
export class Warnings {
  constructor() {
    /** @type {Map<string, Note & {seenMs: number}>} by id */
    this.flagged = new Map();
    this.belowShare = 0; // of the messages of the last half second
  }

  clear() {
    this.belowShare = 0;
    this.flagged.clear();
  }

  /** Collect the flags of a message, also of those between two drawings. */
  addFrame(node, frame, nowMs) {
    const flag = (key, text, id = key) => this.flagged.set(id, { key, id, text, seenMs: nowMs });
    const below = frame.estimate_flags & ESTIMATE.EXTRAPOLATED ? 1 : 0;
    this.belowShare += (below - this.belowShare) / SETTLE_MESSAGES;
    if (this.belowShare > 0.5) flag("below_range", BELOW_RANGE);
    for (const [bit, key, text] of FROM_ESTIMATE) if (frame.estimate_flags & bit) flag(key, text);
    for (const [bit, key, text] of FROM_FRAME) if (frame.frame_flags & bit) flag(key, text);
    node.tiles.forEach((tile, i) => {
      const isOverRange = frame.tile_flags?.[i] & TILE.OVER_RANGE;
      if (isOverRange && !frame.saturated?.[i]) flag("over_range", `${tile.serial} is outside its chip's range.`, `over_range ${tile.serial}`);
      if (frame.estimate_flags & ESTIMATE.CLIPPED && frame.saturated?.[i] && !isOverRange) flag("clipped", clippedText(tile, frame.gauge_kpa?.[i]), `clipped ${tile.serial}`);
    });
  }

  /** Return the current warnings. @returns {Note[]} */
  list(node, frame, nowMs, serverNowMs) {
    const notes = nodeWarnings(node, frame, serverNowMs);
    for (const [id, note] of this.flagged) {
      if (nowMs - note.seenMs > HOLD_MS) this.flagged.delete(id);
      else notes.push(note);
    }
    return notes;
  }
}

/** List of warnings on the live page, and the line of facts. */
export class Notes {
  constructor() {
    this.list = byId("notes");
    this.warnings = new Warnings();
    this.items = new Map(); // id of a note -> element
    this.more = byId("notes-more");
    this.isExpanded = false;
    this.more.addEventListener("click", () => {
      this.isExpanded = !this.isExpanded;
      this.fold();
    });
    this.beganMs = performance.now(); // first warnings may be older
  }

  clear() {
    this.warnings.clear();
    this.items.clear();
    this.beganMs = performance.now();
  }

  addFrame(node, frame, nowMs) {
    this.warnings.addFrame(node, frame, nowMs);
  }

  /** Draw warnings and facts. `problems`: damaged files on the server, shown without a node, too. */
  draw(node, frame, nowMs, serverNowMs, problems = []) {
    const notes = [
      ...(node ? this.warnings.list(node, frame, nowMs, serverNowMs) : []),
      ...problems.map((problem) => makeNote("damaged", sentence(`file problem on the server: ${problem}`), `damaged ${problem}`)),
    ];
    const items = new Map();
    for (const note of notes) {
      const element = this.items.get(note.id) ?? makeItem(note, nowMs - this.beganMs < FIRST_MS);
      setText(element.querySelector(".note-text"), note.text);
      items.set(note.id, element);
    }
    this.items = items;
    const shown = [...items.values()];
    // Keep elements: one may be open, or have the focus.
    for (const old of [...this.list.children]) if (!shown.includes(old)) old.remove();
    shown.forEach((one, i) => { if (this.list.children[i] !== one) this.list.insertBefore(one, this.list.children[i] ?? null); });
    this.fold();
    const [age, kind] = node ? tareTexts(node, serverNowMs) : ["", ""];
    const tared = age + kind;
    const others = node ? facts(node, frame) : "";
    setText(byId("tared"), age); // on a phone, where warnings take the line of facts
    setText(byId("tare-fact"), tared && others ? `${tared} · ` : tared);
    setText(byId("other-facts"), others);
  }

  /** Show the first warning in one line and the number of others, so that the cards below do not move. */
  fold() {
    const more = this.items.size - 1;
    if (more < 1) this.isExpanded = false;
    setData(this.list, "folded", String(!this.isExpanded));
    this.more.hidden = more < 1;
    this.more.setAttribute("aria-expanded", String(this.isExpanded));
    setText(this.more, this.isExpanded ? "Show less" : `${more} more`);
  }
}

/** @param {string} key @param {string} text @param {string} [id] @returns {Note} */
const makeNote = (key, text, id = key) => ({ key, id, text });

/** Make the element of a note: text and start time; opened, reason and remedy. */
function makeItem({ key, text }, mayBeOlder) {
  const clock = localTime(new Date()).slice(11);
  const since = el("time", { text: mayBeOlder ? ` since ${clock} or earlier` : ` since ${clock}` });
  const why = whyOf(key);
  const label = el("span", { cls: "note-text", text });
  const help = helpOf(key);
  const link = help ? el("a", { href: help, target: "_blank", text: "Troubleshooting" }) : "";
  const [ask, answer] = why ? [[el("span", { cls: "ask", text: "Why?" })], [el("p", {}, `${why} `, link)]] : [[], []];
  return el("li", {}, el("details", {}, el("summary", {}, label, since, " ", ...ask), ...answer));
}

/** Return warnings from the node's description and the frame's lasting flags. @returns {Note[]} */
function nodeWarnings(node, frame, serverNowMs) {
  const notes = [];
  const add = (key, text, id = key) => notes.push(makeNote(key, text, id));
  const bits = frame?.estimate_flags ?? 0;
  const tare = node.tare && !node.tare.undone ? node.tare : null;
  if (node.storage_problem) add("storage", `The server cannot record: ${node.storage_problem}`);
  if (!node.calibration) add("no_calibration", withReason("No calibration", node.calibration_problem || "pressures only."));
  if (bits & ESTIMATE.TARE_LOST) add("tare", "Tare lost: forces unknown.", "tare_lost");
  if (!tare) add("tare", withReason("Not tared", node.tare_problem || "lift the foot and press Tare."));
  else {
    if (node.tare_problem) add("tare_doubt", `Tare: ${node.tare_problem}.`, "tare_problem");
    // The flag alone while the node's description is not there yet.
    const doubts = node.tare_warnings ?? [];
    doubts.forEach((doubt, i) => add("tare_doubt", `Tare in doubt: ${doubt}.`, `tare_doubt ${i}`));
    if (!doubts.length && bits & ESTIMATE.TARE_OLD) add("tare_doubt", `Tare in doubt (${tareAge(tare, serverNowMs)} old): lift the foot, press Tare.`);
  }
  if (node.compiling) add("compiling", "Models are being compiled, once on this machine: pressures only until then.");
  for (const warning of node.warnings ?? []) add("", sentence(warning), warning);
  for (const [reason, text] of lossTexts(node.lost)) add("lost", `Lost ${text}.`, `lost ${reason}`);
  // An emulated node has the clock of this machine.
  if (node.clock_set === false && !node.emulated) add("clock", "The node's clock is not set: dates may be wrong.");
  // The last one, as it stays all day: on a phone it would cover what has just happened.
  if (node.calibration && (node.calibration.absolute_scale === "assumed" || bits & ESTIMATE.ASSUMED_SCALE)) {
    add("scale_assumed", "Scale assumed: newtons are approximate.");
  }
  return notes;
}

/** Return "What: reason", without repeating what the reason starts with. */
const withReason = (what, why) => (why.toLowerCase().startsWith(what.toLowerCase()) ? why[0].toUpperCase() + why.slice(1) : `${what}: ${why}`);

const sentence = (text) => `${text[0]?.toUpperCase() ?? ""}${text.slice(1)}${/[.!?]$/.test(text) ? "" : "."}`;

/** Return the text of a clipped tile. @param {TileView} tile @param {number | null | undefined} gaugeKpa */
const clippedText = ({ serial }, gaugeKpa) => `${serial} stops rising ${Number.isFinite(gaugeKpa) ? `above ${number(gaugeKpa, 0)} kPa` : "below its range"}: force is a lower bound.`;

const tareAge = (tare, serverNowMs) => roughly((serverNowMs - tare.t_ns / 1e6) / 1000);

const FOLLOWS = { paused: "automatic tare paused after an undo: press Tare to resume it", off: "automatic tare off" };

/** Return age and kind of the tare as texts, both "" without one. */
function tareTexts({ tare }, serverNowMs) {
  if (!tare || tare.undone) return ["", ""];
  return [`Tared ${tareAge(tare, serverNowMs)} ago`, TARE_SOURCES[tare.source] ? `, ${TARE_SOURCES[tare.source]}` : ""];
}

/** Return the facts about drift, calibration and clock. */
function facts(node, frame) {
  const parts = [];
  const perHour = node.drift?.grf_n_per_hour;
  if (Number.isFinite(perHour) && Math.abs(perHour) >= 0.1) parts.push(`zero drifts ${number(perHour)} N/h`);
  if (FOLLOWS[node.auto_tare]) parts.push(FOLLOWS[node.auto_tare]);
  if (node.calibration) parts.push(node.calibration.absolute_scale === "measured" ? "calibrated in newtons" : "scale assumed");
  if (!node.clock) parts.push("clock offset unknown");
  if (frame && frame.frame_flags & FRAME.LEAD) parts.push("unloaded lead-in");
  return parts.join(" · ");
}
