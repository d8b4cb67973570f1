// Faults of frames: texts, and how plots show them.

import { ESTIMATE_FLAGS, FRAME, FRAME_FLAGS, TILE, TILE_FLAGS } from "../common/flags.js";

/** Return the bits of flags of a severity. @param {[bit: number, title: string, severity: string][]} flags */
const bitsOf = (flags, severity) => flags.reduce((bits, [bit, , its]) => (its === severity ? bits | bit : bits), 0);
const UNREAD = bitsOf(TILE_FLAGS, "unknown");
const SATURATED = bitsOf(ESTIMATE_FLAGS, "bound");
const UNKNOWN = bitsOf(ESTIMATE_FLAGS, "unknown");
const DOUBT = bitsOf(ESTIMATE_FLAGS, "doubt");

const anyTile = (bins, i, bits) => bins.serials.some((_, tile) => bins.columns[`tile_flags_${tile}`][i] & bits);
const estimate = (bins, i) => bins.columns.estimate_flags?.[i] ?? 0;

/**
 * Kinds of faults: `label` in the legend, hatching `way` or "line" for a strip below the plot, plots it
 * is drawn `over`, and `is` for the bins that have it; `before`: frames missing before a frame.
 */
export const KINDS = [
  { key: "lost", label: "frames lost", colour: "text", way: "\\", over: "all", before: true,
    is: (bins, i) => bins.columns.missing[i] > 0 },
  { key: "restarted", label: "node restarted", colour: "text", way: "\\", over: "all", before: true,
    is: (bins, i) => i > 0 && bins.columns.part[i] !== bins.columns.part[i - 1] },
  { key: "late", label: "not sampled (node late)", colour: "edge", way: "x", over: "foot", before: true,
    is: (bins, i) => Boolean(bins.columns.frame_flags[i] & FRAME.OVERRUN) },
  { key: "saturated", label: "tile saturated: lower bound", colour: "warn-line", way: "/", over: "force",
    is: (bins, i) => Boolean(estimate(bins, i) & SATURATED) || (!bins.estimated && anyTile(bins, i, TILE.OVER_RANGE)) },
  { key: "unread", label: "no reading from a tile", colour: "bad-line", way: "x", over: "force",
    is: (bins, i) => anyTile(bins, i, UNREAD) || Boolean(bins.columns.frame_flags[i] & FRAME.BUS_FAULT) },
  { key: "unknown", label: "force unknown", colour: "bad-line", way: "/", over: "force",
    is: (bins, i) => Boolean(estimate(bins, i) & UNKNOWN) },
  { key: "doubt", label: "force less certain", colour: "warn-line", way: "line", over: "foot",
    is: (bins, i) => Boolean(estimate(bins, i) & DOUBT) },
];

/** Return intervals [from, to] of a kind, seconds; missing frames reach back to the previous bin. */
export function stretchesOf(kind, bins, begin, end) {
  const found = [];
  for (let i = begin; i < end; i++) {
    if (!kind.is(bins, i)) continue;
    const back = kind.before && i > 0;
    const from = back ? bins.last[i - 1] : bins.first[i];
    // Missing frames lie before the frame; in a bin of several frames, before or between them. No bin has two parts.
    const to = back && (bins.framesInBin === 1 || kind.key === "restarted") ? bins.first[i] : bins.edge(i);
    if (found.length && from <= found.at(-1)[1] + 1e-9) found.at(-1)[1] = to;
    else found.push([from, to]);
  }
  return found;
}

/** Return the titles of flags that are set. @param {[bit: number, title: string, severity: string][]} flags */
const titlesOf = (flags, bits) => flags.filter(([bit]) => bits & bit).map(([, title]) => title);

/** Return the texts of estimate flags. */
export const estimateTexts = (bits) => titlesOf(ESTIMATE_FLAGS, bits);

/** Return the faults of a bin as texts. */
export function flagTexts(bins, i) {
  const texts = [
    ...estimateTexts(estimate(bins, i)),
    ...titlesOf(FRAME_FLAGS, bins.columns.frame_flags[i]),
  ];
  const unread = bins.serials.filter((_, tile) => bins.columns[`tile_flags_${tile}`][i] & UNREAD);
  if (unread.length) texts.push(`no reading from ${unread.slice(0, 4).join(", ")}${unread.length > 4 ? " and others" : ""}`);
  const missing = bins.columns.missing[i];
  if (missing) texts.push(`${missing.toLocaleString("en-GB")} frame${missing === 1 ? "" : "s"} lost ${bins.framesInBin === 1 ? "before it" : "here"}`);
  return texts;
}
