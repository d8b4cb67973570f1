// Reading of one tile in one unit: value, bound, or the reason for none.

import { TILE, TILE_FLAGS } from "../common/flags.js";

const FALLBACK = { kPa: 15, N: 30 };

/** @type {[bit: number, state: string, text: string][]} */
const FAULTS = TILE_FLAGS.map(([bit, title]) => [bit, Object.keys(TILE).find((name) => TILE[name] === bit).toLowerCase(), title]);
export const FAULT_STATES = new Set(FAULTS.map(([, state]) => state));

/** Return the unit of a tile: a reference tile bears no load, so it has no newtons. */
export const unitOf = (tile, unit) => (tile.reference ? "kPa" : unit);

const ratedScale = (tile, unit) => (unit === "kPa" ? tile.range_kpa?.[1] : tile.full_scale_n);
export const hasFullScale = (tile, unit) => ratedScale(tile, unit) > 0;

export function fullScale(tile, unit) {
  return hasFullScale(tile, unit) ? ratedScale(tile, unit) : FALLBACK[unit];
}

const at = (list, i) => (Number.isFinite(list?.[i]) ? list[i] : null);

/**
 * Return {state, text, bound, value, low, high, sigma, unit}: `value` is null unless the state is "ok";
 * `text` replaces the number, `bound` is the lower bound of a saturated tile.
 */
export function readTile(node, i, frame, unitChosen) {
  const tile = node.tiles[i];
  const unit = unitOf(tile, unitChosen);
  const none = (state, text, bound = "") => ({ state, text, bound, value: null, low: null, high: null, sigma: null, unit });
  if (!frame || !Number.isFinite(frame.tile_flags?.[i])) return none("waiting", "no data");

  for (const [bit, state, text] of FAULTS) if (frame.tile_flags[i] & bit) return none(state, text);

  const value = unit === "kPa" ? at(frame.gauge_kpa, i) : at(frame.force_n, i);
  if (frame.saturated?.[i]) return none("saturated", "saturated", lowerBound(tile, unit, value));
  if (value === null) {
    if (!node.tare || node.tare.undone) return none("not_tared", "not tared");
    if (unit === "N" && (!node.calibration || !tile.full_scale_n)) return none("no_calibration", "no calibration");
    return none("waiting", "no value");
  }
  const [low, high, sigma] = unit === "kPa"
    ? [frame.gauge_min_kpa, frame.gauge_max_kpa, null]
    : [frame.force_min_n, frame.force_max_n, frame.force_sigma_n];
  return {
    state: "ok", text: "", bound: "", value, unit,
    low: at(low, i), high: at(high, i), sigma: at(sigma, i),
  };
}

/** Return the lower bound, rounded down: force from the server; pressure from range end or reading. */
function lowerBound(tile, unit, value) {
  const bound = unit === "kPa" ? Math.max(ratedScale(tile, unit) ?? -Infinity, value ?? -Infinity) : value;
  if (!Number.isFinite(bound)) return "";
  return unit === "kPa" ? (Math.floor(bound * 10) / 10).toFixed(1) : String(Math.floor(bound));
}
