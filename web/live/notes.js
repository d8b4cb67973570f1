// Plain notes about what to trust. They change seldom: an estimate's flag is held so it can be read.

import { ESTIMATE, FRAME, TILE } from "../common/bits.js";
import { lossesInWords } from "../common/losses.js";
import { byId, el, localTime, number, roughly, setData, setText } from "../common/text.js";
import { helpOf, whyOf } from "./why.js";

const HOLD_MS = 3000;
const FIRST_MS = 3000; // what is said so soon after the page was opened may be older

// A chip throws an outlier now and then, which is no suction: this flag has to stay for a while.
const BELOW_RANGE = "Below the calibrated range: suction, or an old tare.";
const SETTLE_MESSAGES = 15;
/** @type {[bit: number, text: string][]} */
const FROM_ESTIMATE = [
  [ESTIMATE.TILE_MISSING, "Tile missing: of the force only a lower bound is known, and no COP."],
  [ESTIMATE.STUCK, "A tile repeats one reading: its force is not known. Unplug it and plug it in again."],
  [ESTIMATE.CLIPPED, "A tile reads no further than some pressure within its range: force is at least this."],
  [ESTIMATE.BASELINE_LOST, "A tile reads too little without a load, or has warmed or cooled: force is less certain. Lift the foot, press Tare; if it comes back, the dome may leak."],
  [ESTIMATE.AFTER_SATURATION, "After a load that was not seen, force is less certain for a while."],
  [ESTIMATE.OVER_RATED, "Above the 115 kPa the chip is rated for, yet calibrated."],
];
/** @type {[bit: number, text: string][]} */
const FROM_FRAME = [
  [FRAME.BUS_FAULT, "Bus fault: the node cannot read all tiles. Check its cable and supply."],
  [FRAME.OVERRUN, "The node is late: some frames are not sampled."],
];

/** Texts of what is doubtful about a node and its frames, held long enough to be read. */
export class Warnings {
  constructor() {
    this.seenMs = new Map(); // text of a flag -> when it was last set
    this.belowShare = 0; // of the last half second's messages
  }

  clear() {
    this.belowShare = 0;
    this.seenMs.clear();
  }

  /** Called per message, so that a flag between two drawings counts. */
  see(node, frame, nowMs) {
    const mark = (text) => this.seenMs.set(text, nowMs);
    const below = frame.estimate_status & ESTIMATE.EXTRAPOLATED ? 1 : 0;
    this.belowShare += (below - this.belowShare) / SETTLE_MESSAGES;
    if (this.belowShare > 0.5) mark(BELOW_RANGE);
    for (const [bit, text] of FROM_ESTIMATE) if (frame.estimate_status & bit) mark(text);
    for (const [bit, text] of FROM_FRAME) if (frame.frame_status & bit) mark(text);
    node.tiles.forEach((tile, i) => {
      if (frame.status?.[i] & TILE.OVER_RANGE && !frame.saturated?.[i]) mark(`${tile.serial} is out of the chip's range of 50 to 115 kPa.`);
    });
  }

  /** Those that stand now. @returns {string[]} */
  list(node, frame, nowMs, serverNowMs) {
    const texts = standing(node, frame, serverNowMs);
    for (const [text, seenMs] of this.seenMs) {
      if (nowMs - seenMs > HOLD_MS) this.seenMs.delete(text);
      else texts.push(text);
    }
    return texts;
  }
}

export class Notes {
  constructor() {
    this.list = byId("notes");
    this.warnings = new Warnings();
    this.items = new Map(); // of what is said -> its element
    this.more = byId("notes-more");
    this.unfolded = false;
    this.more.addEventListener("click", () => {
      this.unfolded = !this.unfolded;
      this.fold();
    });
    this.beganMs = performance.now(); // what is there at first may have been there before
  }

  clear() {
    this.warnings.clear();
    this.items.clear();
    this.beganMs = performance.now();
  }

  see(node, frame, nowMs) {
    this.warnings.see(node, frame, nowMs);
  }

  /** `problems`: what the server found damaged; said without a node, too. */
  draw(node, frame, nowMs, serverNowMs, problems = []) {
    const notes = [
      ...(node ? this.warnings.list(node, frame, nowMs, serverNowMs) : []),
      ...problems.map((problem) => sentence(`damaged on the server: ${problem}`)),
    ];
    const items = new Map();
    for (const text of notes) {
      const same = items.has(kindOf(text)) ? text : kindOf(text);
      const one = this.items.get(same) ?? item(text, nowMs - this.beganMs < FIRST_MS);
      setText(one.querySelector(".note-text"), text);
      items.set(same, one);
    }
    this.items = items;
    const wanted = [...items.values()];
    // What stands stays: it may be open, or have the focus.
    for (const old of [...this.list.children]) if (!wanted.includes(old)) old.remove();
    wanted.forEach((one, i) => { if (this.list.children[i] !== one) this.list.insertBefore(one, this.list.children[i] ?? null); });
    this.fold();
    setText(byId("facts"), node ? facts(node, frame, serverNowMs) : "");
  }

  /** The first in one line, and a count of the others: what is measured stays where it is. */
  fold() {
    const more = this.items.size - 1;
    if (more < 1) this.unfolded = false;
    setData(this.list, "folded", String(!this.unfolded));
    this.more.hidden = more < 1;
    this.more.setAttribute("aria-expanded", String(this.unfolded));
    setText(this.more, this.unfolded ? "Only the first" : `${more} more`);
  }
}

/** What counts up is still the same note. */
const kindOf = (text) => (/^(Lost|Tare) /.test(text) ? text.replace(/\d[\d,.]*/g, "#") : text);

/** A note with the time since when it stands; opened, it is shown in full, with two sentences on why. */
function item(text, mayBeOlder) {
  const clock = localTime(new Date()).slice(11);
  const since = el("time", { text: mayBeOlder ? ` since ${clock} or before` : ` since ${clock}` });
  const why = whyOf(text);
  const says = el("span", { cls: "note-text", text });
  const help = helpOf(text);
  const link = help ? el("a", { href: help, target: "_blank", text: "What to do" }) : "";
  const [ask, answer] = why ? [[el("span", { cls: "ask", text: "why?" })], [el("p", {}, `${why} `, link)]] : [[], []];
  return el("li", {}, el("details", {}, el("summary", {}, says, since, " ", ...ask), ...answer));
}

function standing(node, frame, serverNowMs) {
  const notes = [];
  const bits = frame?.estimate_status ?? 0;
  const tare = node.tare && !node.tare.undone ? node.tare : null;
  if (!node.calibration) notes.push(said("No calibration", node.calibration_problem || "pressures only, no newtons."));
  else if (node.calibration.absolute_scale === "assumed" || bits & ESTIMATE.ASSUMED_SCALE) {
    notes.push("Scale assumed, not measured: newtons are not to be trusted.");
  }
  if (bits & ESTIMATE.TARE_LOST) notes.push("Tare lost: no force is known.");
  if (!tare) notes.push(said("Not tared", node.tare_problem || "lift the foot off the ground and press Tare."));
  else {
    if (node.tare_problem) notes.push(`Tare: ${node.tare_problem}.`);
    // In the server's words; the flag alone says as much while a node's description is on its way.
    const doubts = node.tare_warnings ?? [];
    for (const doubt of doubts) notes.push(`Tare in doubt: ${doubt}.`);
    if (!doubts.length && bits & ESTIMATE.TARE_OLD) notes.push(`Tare in doubt (${tareAge(tare, serverNowMs)} old): lift the foot, press Tare.`);
  }
  for (const trouble of node.troubles ?? []) notes.push(sentence(trouble));
  for (const loss of lossesInWords(node.lost)) notes.push(`Lost ${loss}.`);
  if (node.storage_problem) notes.push(`Nothing is being kept by the server: ${node.storage_problem}`);
  // An emulated node runs on this machine, and its date is nobody's concern.
  if (node.clock_set === false && !node.emulated) notes.push("Clock of the node not set: dates may be wrong.");
  return notes;
}

/** The reason, without saying twice what it begins with. */
const said = (what, why) => (why.toLowerCase().startsWith(what.toLowerCase()) ? why[0].toUpperCase() + why.slice(1) : `${what}: ${why}`);

const sentence = (text) => `${text[0]?.toUpperCase() ?? ""}${text.slice(1)}${/[.!?]$/.test(text) ? "" : "."}`;

const tareAge = (tare, serverNowMs) => roughly((serverNowMs - tare.t_ns / 1e6) / 1000);

const SOURCES = { lead: "at the start", unloaded: "by hand", recognised: "recognised in flight", flight: "by itself in flight" };
const FOLLOWS = { paused: "no automatic tare, one was undone: press Tare to allow it again", off: "automatic tare off" };

function facts(node, frame, serverNowMs) {
  const tare = node.tare && !node.tare.undone ? node.tare : null;
  const parts = [];
  if (tare) parts.push(`Tared ${tareAge(tare, serverNowMs)} ago${SOURCES[tare.source] ? `, ${SOURCES[tare.source]}` : ""}`);
  const perHour = node.drift?.grf_n_per_hour;
  if (Number.isFinite(perHour) && Math.abs(perHour) >= 0.1) parts.push(`zero drifts ${number(perHour)} N/h`);
  if (FOLLOWS[node.auto_tare]) parts.push(FOLLOWS[node.auto_tare]);
  if (node.calibration) parts.push(`calibration “${node.calibration.name}”${node.calibration.absolute_scale === "measured" ? ", in newtons" : ", scale assumed"}`);
  if (!node.clock) parts.push("clock offset not measured yet");
  if (frame && frame.frame_status & FRAME.LEAD) parts.push("unloaded lead-in of the scene");
  return parts.join(" · ");
}
