// What is wrong with some frames, in words, and how plots show it.

import { ESTIMATE, FRAME, TILE } from "../common/bits.js";

const UNREAD = TILE.NO_ANSWER | TILE.STALE | TILE.IMPLAUSIBLE | TILE.NOT_CONVERTED;
const SATURATED = ESTIMATE.SATURATED | ESTIMATE.CLIPPED;
const UNKNOWN = ESTIMATE.TILE_MISSING | ESTIMATE.STUCK | ESTIMATE.TARE_LOST;
const DOUBT = ESTIMATE.EXTRAPOLATED | ESTIMATE.TARE_OLD | ESTIMATE.OVER_RATED
  | ESTIMATE.AFTER_SATURATION | ESTIMATE.BASELINE_LOST;

const anyTile = (bins, i, bits) => bins.serials.some((_, tile) => bins.columns[`status_${tile}`][i] & bits);
const estimate = (bins, i) => bins.columns.estimate_status?.[i] ?? 0;

/**
 * Each: what it is called in the legend, how it is drawn, over which plots, and of which bins it is true.
 * `way` is that of the hatching, or "line" for a strip at the foot of the plot; `before`: it is what is
 * missing before a frame.
 */
export const KINDS = [
  { key: "lost", says: "frames lost", colour: "text", way: "\\", over: "all", before: true,
    is: (bins, i) => bins.columns.missing[i] > 0 },
  { key: "restarted", says: "the node was started again", colour: "text", way: "\\", over: "all", before: true,
    is: (bins, i) => i > 0 && bins.columns.part[i] !== bins.columns.part[i - 1] },
  { key: "late", says: "not sampled: the node was late", colour: "edge", way: "x", over: "foot", before: true,
    is: (bins, i) => Boolean(bins.columns.frame_status[i] & FRAME.OVERRUN) },
  { key: "saturated", says: "a tile is saturated: the force is at least this", colour: "warn-line", way: "/", over: "force",
    is: (bins, i) => Boolean(estimate(bins, i) & SATURATED) || (!bins.estimated && anyTile(bins, i, TILE.OVER_RANGE)) },
  { key: "unread", says: "a tile gave no reading", colour: "bad-line", way: "x", over: "force",
    is: (bins, i) => anyTile(bins, i, UNREAD) || Boolean(bins.columns.frame_status[i] & FRAME.BUS_FAULT) },
  { key: "unknown", says: "the force is not known", colour: "bad-line", way: "/", over: "force",
    is: (bins, i) => Boolean(estimate(bins, i) & UNKNOWN) },
  { key: "doubt", says: "force less certain", colour: "warn-line", way: "line", over: "foot",
    is: (bins, i) => Boolean(estimate(bins, i) & DOUBT) },
];

/** Stretches of bins of a kind as [from, to] in seconds; what is lost reaches back to the bin before. */
export function stretchesOf(kind, bins, begin, end) {
  const found = [];
  for (let i = begin; i < end; i++) {
    if (!kind.is(bins, i)) continue;
    const back = kind.before && i > 0;
    const from = back ? bins.last[i - 1] : bins.first[i];
    // What is missing is before the frame; of several frames, before or between them. No bin has two parts.
    const to = back && (bins.framesInBin === 1 || kind.key === "restarted") ? bins.first[i] : bins.edge(i);
    if (found.length && from <= found.at(-1)[1] + 1e-9) found.at(-1)[1] = to;
    else found.push([from, to]);
  }
  return found;
}

/** @type {[bit: number, words: string][]} */
const ESTIMATE_WORDS = [
  [ESTIMATE.SATURATED, "a tile is saturated"],
  [ESTIMATE.CLIPPED, "a tile reads no further than some pressure within its range"],
  [ESTIMATE.TILE_MISSING, "a tile gave no pressure"],
  [ESTIMATE.STUCK, "a tile repeats one reading"],
  [ESTIMATE.TARE_LOST, "tare lost"],
  [ESTIMATE.EXTRAPOLATED, "a tile is below its calibrated range"],
  [ESTIMATE.TARE_OLD, "tare in doubt"],
  [ESTIMATE.BASELINE_LOST, "a tile's zero has moved"],
  [ESTIMATE.AFTER_SATURATION, "less certain after a load that was not seen"],
  [ESTIMATE.OVER_RATED, "above the pressure the chip is rated for"],
  [ESTIMATE.OUTLIER_REPLACED, "an outlier was replaced"],
  [ESTIMATE.ASSUMED_SCALE, "scale assumed"],
];
/** @type {[bit: number, words: string][]} */
const FRAME_WORDS = [
  [FRAME.BUS_FAULT, "the bus failed"],
  [FRAME.OVERRUN, "slots before it not sampled"],
  [FRAME.SERVO_STALE, "servo's angle is old"],
  [FRAME.SERVO_TURN_UNKNOWN, "servo's turn is not known"],
  [FRAME.LEAD, "unloaded lead-in"],
  [FRAME.NEW_ARRAY_INFO, "the array was looked for again"],
];

export const estimateWords = (bits) => ESTIMATE_WORDS.filter(([bit]) => bits & bit).map(([, words]) => words);

/** All that is to be known of a bin beside its numbers. */
export function flagsInWords(bins, i) {
  const words = [
    ...estimateWords(estimate(bins, i)),
    ...FRAME_WORDS.filter(([bit]) => bins.columns.frame_status[i] & bit).map(([, text]) => text),
  ];
  const unread = bins.serials.filter((_, tile) => bins.columns[`status_${tile}`][i] & UNREAD);
  if (unread.length) words.push(`no reading of ${unread.slice(0, 4).join(", ")}${unread.length > 4 ? " and others" : ""}`);
  const missing = bins.columns.missing[i];
  if (missing) words.push(`${missing.toLocaleString("en-GB")} frame${missing === 1 ? "" : "s"} lost ${bins.framesInBin === 1 ? "before it" : "here"}`);
  return words;
}
