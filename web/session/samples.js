// Stored frames of a session in slices: prefetched, in bounded memory.

import * as api from "../common/api.js";
import { lowerBound } from "./bins.js";

const VALUES_IN_SLICE = 20_000; // parsed within milliseconds
const SLICE_MOST_S = 1;
const SLICE_LEAST_S = 0.05;
const SLICES_MAX = 48; // 8 MB at most
const REQUESTS_MAX = 3;
const RETRY_MS = 2000;
const UNSETTLED_S = 1; // end of a running recording: look-ahead changes its estimates
const APART_S = 0.1; // a frame further away does not belong to an instant

const BY_TILE = ["tile_flags", "force_n", "force_sigma_n", "gauge_kpa"];
const BY_FRAME = [
  "seq", "frame_flags", "estimate_flags", "contact", "grf_n", "grf_sigma_n", "grf_lower_bound_n",
  "cop_x_m", "cop_y_m", "cop_sigma_x_m", "cop_sigma_y_m", "angle_rad",
];
const RAW = ["seq", "frame_flags", "tile_flags"];

/**
 * Parse the columns of CSV; unknown values are NaN.
 * @param {string} csv
 * @returns {Record<string, Float64Array>}
 */
export function columnsOf(csv) {
  const lines = csv.split("\n");
  while (lines.length > 1 && lines.at(-1) === "") lines.pop();
  const names = lines[0].trim().split(",").map((name) => name.replaceAll('"', ""));
  const rows = lines.length - 1;
  const values = names.map(() => new Float64Array(rows));
  for (let row = 0; row < rows; row++) {
    const fields = lines[row + 1].trim().split(",");
    for (let i = 0; i < names.length; i++) values[i][row] = fields[i] === "" ? NaN : Number(fields[i]);
  }
  return Object.fromEntries(names.map((name, i) => [name, values[i]]));
}

/** @typedef {FrameMessage & {timeS: number}} TimedFrame `timeS`: seconds after the first frame */

/** Return the frame of a row, with the fields of a live message. @returns {TimedFrame} */
function frameOf({ timeS, columns }, row, tiles) {
  const one = (name) => { const value = columns[name]?.[row]; return Number.isFinite(value) ? value : null; };
  const each = (name) => Array.from({ length: tiles }, (_, i) => one(`${name}_${i}`));
  /** @type {any} */
  const frame = Object.fromEntries([...BY_FRAME.map((name) => [name, one(name)]), ...BY_TILE.map((name) => [name, each(name)])]);
  // A lower bound is a force without an uncertainty.
  frame.saturated = frame.force_n.map((force, i) => force !== null && frame.force_sigma_n[i] === null);
  frame.contact = frame.contact === null ? null : Boolean(frame.contact);
  [frame.force_max_n, frame.gauge_max_kpa] = [frame.force_n, frame.gauge_kpa]; // of this frame alone
  frame.timeS = timeS[row];
  return frame;
}

/** Cache of slices. */
export class Samples {
  /**
   * @param {string} id
   * @param {import("./bins.js").Bins} whole bins of the whole session: they show where frames are
   * @param {number} rateHz approximate frame rate
   * @param {{loaded: () => void, failed: (error: Error) => void}} on
   */
  constructor(id, whole, rateHz, on) {
    this.id = id;
    this.whole = whole;
    this.on = on;
    this.tiles = whole.serials.length;
    this.names = ["time_s", ...(whole.estimated ? [...BY_FRAME, ...BY_TILE] : RAW)];
    const values = whole.estimated ? BY_TILE.length * this.tiles + BY_FRAME.length : this.tiles + 2;
    this.sliceS = Math.round(1e3 * Math.min(SLICE_MOST_S, Math.max(SLICE_LEAST_S, VALUES_IN_SLICE / (values * rateHz)))) * 1e-3;
    this.slices = new Map(); // number -> slice, or its promise
    this.notBeforeMs = 0; // after a refusal
  }

  /** Update after the session has grown: its former end is loaded again. */
  grow(whole) {
    const missing = (bins) => bins.sum("missing", 0, bins.count);
    // Late frames lie between others and change later estimates.
    const settled = missing(whole) < missing(this.whole) ? 0 : this.numberOf(this.whole.durationS - UNSETTLED_S);
    for (const number of [...this.slices.keys()]) if (number >= settled) this.slices.delete(number);
    this.whole = whole;
  }

  /**
   * Return the nearest frame, unless it is too far away.
   * @returns {{known: boolean, frame: TimedFrame | null}} not known: not loaded yet
   */
  at(timeS) {
    const own = this.numberOf(timeS);
    let best = null;
    let known = true;
    for (const number of new Set([own, this.numberOf(timeS - APART_S), this.numberOf(timeS + APART_S)])) {
      // No other slice has a frame that near.
      if (number !== own && best && best.apart <= this.toEdge(timeS)) break;
      const slice = this.slices.get(number);
      known &&= Boolean(slice?.timeS);
      if (!slice?.timeS) continue;
      const next = lowerBound(slice.timeS, timeS);
      for (const row of [next - 1, next]) {
        const apart = Math.abs(slice.timeS[row] - timeS);
        if (apart <= APART_S && !(best?.apart <= apart)) best = { apart, slice, row };
      }
    }
    return { known, frame: known && best ? frameOf(best.slice, best.row, this.tiles) : null };
  }

  /** Return the distance of an instant to the nearer edge of its slice. */
  toEdge(timeS) {
    const into = timeS - this.numberOf(timeS) * this.sliceS;
    return Math.min(into, this.sliceS - into);
  }

  /** Return the slice of an instant; slices start at whole nanoseconds, as on the server. */
  numberOf(timeS) {
    const place = (s) => Math.floor(Math.round(s * 1e9) / Math.round(this.sliceS * 1e9));
    return Math.min(place(this.whole.durationS), Math.max(0, place(timeS)));
  }

  /** Request the slices around an instant and ahead of it. */
  request(timeS, aheadS) {
    const [first, now] = [this.numberOf(timeS - APART_S), this.numberOf(timeS)];
    const last = Math.min(this.numberOf(timeS + Math.max(APART_S, aheadS)), now + SLICES_MAX - 4);
    const needed = [now, ...Array.from({ length: last - first + 1 }, (_, i) => first + i).filter((n) => n !== now)];
    this.dropOthers(needed, now);
    for (const number of needed) {
      if (this.pendingCount >= REQUESTS_MAX || performance.now() < this.notBeforeMs) return;
      if (!this.slices.has(number)) this.load(number).catch(this.on.failed);
    }
  }

  get pendingCount() { return [...this.slices.values()].filter((slice) => slice instanceof Promise).length; }

  /** Return true if all requested slices are loaded. */
  has(timeS, aheadS) {
    for (let n = this.numberOf(timeS); n <= this.numberOf(timeS + aheadS); n++) if (!this.slices.get(n)?.timeS) return false;
    return true;
  }

  dropOthers(needed, now) {
    const others = [...this.slices.keys()].filter((number) => !needed.includes(number) && this.slices.get(number).timeS);
    others.sort((a, b) => Math.abs(b - now) - Math.abs(a - now));
    for (const number of others.slice(0, Math.max(0, this.slices.size - SLICES_MAX))) this.slices.delete(number);
  }

  /** @returns {Promise<{timeS: Float64Array, columns: Record<string, Float64Array>}>} */
  load(number) {
    const stored = this.slices.get(number);
    if (stored) return Promise.resolve(stored);
    const request = this.fetch(number).then((slice) => {
      if (this.slices.get(number) === request) this.slices.set(number, slice); // else outdated
      this.on.loaded();
      return slice;
    }, (error) => {
      this.slices.delete(number);
      this.notBeforeMs = performance.now() + RETRY_MS;
      throw error;
    });
    this.slices.set(number, request);
    return request;
  }

  async fetch(number) {
    const columns = columnsOf(await api.samples(this.id, {
      columns: this.names.join(","), start_s: number * this.sliceS, end_s: (number + 1) * this.sliceS,
    }));
    return { timeS: columns.time_s, columns };
  }

  /**
   * Return the time of the frame `by` frames from the nearest one, at most the first or last frame.
   */
  async step(timeS, by) {
    let number = this.numberOf(timeS);
    let slice = await this.load(number);
    let row = (slice.timeS.length ? nearest(slice.timeS, timeS) : -Number(by > 0)) + by;
    while (row < 0 || row >= slice.timeS.length) {
      const onward = row >= slice.timeS.length && by > 0;
      const next = onward ? this.after(number) : this.before(number);
      if (next === null) return slice.timeS.at(onward ? -1 : 0) ?? timeS;
      row -= onward ? slice.timeS.length : 0;
      slice = await this.load(number = next);
      row += onward ? 0 : slice.timeS.length;
    }
    return slice.timeS[row];
  }

  /** Return the next slice with frames; null: none. */
  after(number) {
    const { first, last } = this.whole;
    const edgeS = (number + 1) * this.sliceS;
    const bin = lowerBound(last, edgeS);
    return bin < last.length ? Math.max(number + 1, this.numberOf(first[bin])) : null;
  }

  before(number) {
    const { first, last } = this.whole;
    const bin = lowerBound(first, number * this.sliceS) - 1;
    return bin >= 0 && number > 0 ? Math.min(number - 1, this.numberOf(last[bin])) : null;
  }
}

/** Return the index of the element nearest to a value in a sorted list. */
function nearest(list, value) {
  const next = lowerBound(list, value);
  return next === list.length || (next > 0 && value - list[next - 1] <= list[next] - value) ? next - 1 : next;
}
