// Values at the cursor, and a summary of the visible range.

import { byId, el, number, setData, setText } from "../common/text.js";
import { flagTexts } from "./flags.js";
import { timeText } from "./overlay.js";

const TILES_MAX = 8;
const LARGEST_FRAME = "GRF of single frames, noise included. The peak force of a stance is estimated without the bias of this noise: it is usually smaller.";

/** Return "3.1" of a single frame, "1.2 to 3.1" of several. */
function span(bins, i, [lowName, highName], factor = 1, decimals = 1) {
  const [low, high] = [bins.columns[lowName]?.[i] ?? null, bins.columns[highName]?.[i] ?? null];
  if (low === null || high === null) return null;
  const [from, to] = [number(low * factor, decimals), number(high * factor, decimals)];
  return from === to ? to : `${from} to ${to}`;
}

function grfAt(bins, i) {
  const value = span(bins, i, ["grf_n_min", "grf_n_max"]);
  const bound = bins.columns.grf_lower_bound_n_max[i];
  if (value === null) return bound > 0 ? `at least ${number(bound)} N` : "unknown";
  const [low, high] = [bins.columns.grf_low_n_min[i], bins.columns.grf_high_n_max[i]];
  if (low === null || high === null) return `${value} N`;
  if (bins.framesInBin === 1) return `${value} N ± ${number((high - low) / 2)}`;
  return `${value} N (95 %: ${number(low)} to ${number(high)})`;
}

/** Return the half width of the 95 % interval, of a single frame. */
function copHalf(bins, i, axis) {
  const [low, high] = [bins.columns[`cop_${axis}_low_m_min`][i], bins.columns[`cop_${axis}_high_m_max`][i]];
  return bins.framesInBin > 1 || low === null || high === null ? "" : ` ± ${number(500 * (high - low))}`;
}

const CONTACT_TEXTS = { 1: "no", 2: "yes", 4: "unknown", 3: "changes", 5: "no or unknown", 6: "yes or unknown", 7: "changes" };

/** Return the instant of a cursor, and which frames are nearest to it: several in a pixel, or one beside it. */
export function cursorTextOf(bins, i, cursorS) {
  const [many, at, first] = [bins.columns.frames[i], timeText(cursorS, 0.001), timeText(bins.first[i], 0.001)];
  if (many > 1) return `${at} (${many} frames from ${first})`;
  return at === first ? at : `${at} (frame at ${first})`;
}

/**
 * Return the values of a bin for all panels.
 * @param {import("./panels.js").Panel[]} panels
 * @returns {[string, string, string][]} key, name, value
 */
export function readingsOf(bins, i, panels) {
  const shown = new Set(panels.map((panel) => panel.key));
  const many = bins.columns.frames[i];
  const time = timeText(bins.first[i], 0.001);
  /** @type {[string, string, string][]} */
  const found = [["time", "Time", many > 1 ? `${time}, ${many} frames` : time]];
  if (bins.estimated) {
    found.push(["grf", "GRF", grfAt(bins, i)]);
    found.push(["contact", "Contact", CONTACT_TEXTS[bins.columns.contact[i]] ?? "–"]);
    for (const [axis, name] of [["x", "COP forward"], ["y", "COP left"]]) {
      const place = span(bins, i, [`cop_${axis}_m_min`, `cop_${axis}_m_max`], 1e3);
      if (shown.has(`cop-${axis}`)) found.push([`cop-${axis}`, name, place === null ? "–" : `${place} mm${copHalf(bins, i, axis)}`]);
    }
    const noted = panels.find((panel) => panel.note);
    const across = noted?.key === "cop-y" ? "x" : "y";
    if (noted) found.push([`cop-${across}`, `COP ${across}`, "not measured: tiles in one row"]);
    if (shown.has("angle")) {
      const angle = span(bins, i, ["angle_rad_min", "angle_rad_max"], 180 / Math.PI);
      found.push(["angle", "Angle", angle === null ? "–" : `${angle}°`]);
    }
  }
  return found.concat(tilesAt(bins, i).filter(([key]) => shown.has(key) || shown.has("tiles")));
}

/** @returns {[string, string, string][]} */
function tilesAt(bins, i) {
  const [stem, unit, decimals] = bins.estimated ? ["force_n", "N", 1] : ["pressure_raw", "counts", 0];
  /** @returns {[string, string]} */
  const names = (tile) => [`${stem}_${tile}_min`, `${stem}_${tile}_max`];
  const order = bins.serials.map((_, tile) => tile);
  if (order.length <= TILES_MAX) {
    return order.map((tile) => {
      const value = span(bins, i, names(tile), 1, decimals);
      return [`tile-${tile}`, bins.serials[tile], value === null ? "–" : `${value} ${unit}`];
    });
  }
  const load = order.map((tile) => {
    const { low, high } = bins.estimated ? { low: 0, high: 1 } : bins.countRange(tile);
    const value = bins.columns[names(tile)[high > low ? 1 : 0]][i];
    return value === null ? -Infinity : (value - low) / (high - low);
  });
  order.sort((a, b) => load[b] - load[a]);
  const text = order.slice(0, 3).map((tile) => `${bins.serials[tile]} ${span(bins, i, names(tile), 1, decimals) ?? "–"}`).join(", ");
  return [["tiles", "Most loaded", `${text} ${unit}`]];
}

/** List of values at the cursor. */
export class Readout {
  constructor() {
    this.list = byId("readout");
    this.cells = new Map();
  }

  /** Draw the values at a cursor; return them as a sentence for screen readers. */
  draw(bins, cursorS, panels, beside = []) {
    const i = cursorS === null ? -1 : bins.at(cursorS);
    const readings = i < 0 ? [] : [...readingsOf(bins, i, panels), ...beside];
    if (i >= 0) readings[0][2] = cursorTextOf(bins, i, cursorS);
    const flags = i < 0 ? [] : flagTexts(bins, i);
    byId("readout-hint").hidden = i >= 0;
    for (const key of this.cells.keys()) {
      if (readings.some(([one]) => one === key)) continue;
      this.cells.get(key).parentElement.remove();
      this.cells.delete(key);
    }
    for (const [key, name, value] of readings) {
      if (!this.cells.has(key)) {
        const cell = el("dd");
        this.cells.set(key, cell);
        this.list.append(el("div", { "data-key": key }, el("dt", { text: name }), cell));
      }
      setText(this.cells.get(key), value);
    }
    setText(byId("readout-flags"), flags.join(" · "));
    setData(this.list, "timeS", i < 0 ? "" : String(bins.first[i]));
    return [...readings.map(([, name, value]) => `${name} ${value}`), ...flags].join(", ");
  }
}

/** Write the summary of the visible range, and its numbers as data attributes. */
export function drawSummary(bins, view, box) {
  const [begin, end] = bins.within(view);
  const time = (timeS) => timeText(timeS, 0.01);
  const frames = bins.sum("frames", begin, end);
  const parts = [`${time(view.from)} to ${time(view.to)}: ${frames.toLocaleString("en-GB")} frames`];
  const missing = bins.sum("missing", begin, end);
  if (missing) parts.push(`${missing.toLocaleString("en-GB")} lost`);
  const grf = bins.estimated ? bins.extremes("grf_n_min", "grf_n_max", begin, end) : null;
  if (grf) parts.push(`largest frame ${number(grf.high)} N at ${time(bins.columns.grf_n_max_t_s[grf.at])}, smallest ${number(grf.low)} N`);
  const unknown = bins.estimated ? bins.sum("grf_unknown", begin, end) : 0;
  if (unknown) parts.push(`GRF unknown in ${unknown.toLocaleString("en-GB")} frames`);
  if (!bins.estimated) parts.push("no estimates, raw counts");
  parts.push(bins.framesInBin === 1 ? "every frame drawn" : `${bins.framesInBin} frames per pixel column, min to max`);
  setText(box, `${parts.join(", ")}.`);
  box.title = grf ? LARGEST_FRAME : "";
  setData(box, "grfMax", grf ? String(grf.high) : "");
  setData(box, "grfMin", grf ? String(grf.low) : "");
  setData(box, "missing", String(missing));
  setData(box, "frames", String(frames));
  setData(box, "firstS", end > begin ? String(bins.first[begin]) : "");
  setData(box, "lastS", end > begin ? String(bins.last[end - 1]) : "");
}
