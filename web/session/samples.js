// Frames of a session as they are stored, a slice at a time: asked for ahead, kept in bounded memory.

import * as api from "../common/api.js";

const VALUES_IN_SLICE = 20_000; // read from text in some milliseconds: no picture waits for it
const SLICE_MOST_S = 1;
const SLICE_LEAST_S = 0.05;
const KEPT = 48; // slices: eight megabytes at most
const AT_ONCE = 3; // questions to the server
const AGAIN_MS = 2000; // after one that was refused
const UNSETTLED_S = 1; // at the end of a session that is still recorded: estimates look ahead
const APART_S = 0.1; // a frame further away than this is not that of an instant

const BY_TILE = ["status", "force_n", "force_sigma_n", "gauge_kpa"];
const BY_FRAME = [
  "seq", "frame_status", "estimate_status", "contact", "grf_n", "grf_sigma_n", "grf_at_least_n",
  "cop_x_m", "cop_y_m", "cop_sigma_x_m", "cop_sigma_y_m", "angle_rad",
];
const RAW = ["seq", "frame_status", "status"];

/**
 * The columns of CSV as numbers; what is not known is NaN.
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

/** The frame of a row, in the words of a live message. @returns {Frame} */
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

/** First place in a rising list at which `value` is not above. */
function placeOf(list, value) {
  let [low, high] = [0, list.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (list[middle] < value) low = middle + 1;
    else high = middle;
  }
  return low;
}

export class Samples {
  /**
   * @param {string} id
   * @param {import("./bins.js").Bins} whole bins of the whole session: they say where there are frames
   * @param {number} rateHz about how many frames a second there are
   * @param {{come: () => void, failed: (error: Error) => void}} tell
   */
  constructor(id, whole, rateHz, tell) {
    this.id = id;
    this.whole = whole;
    this.tell = tell;
    this.tiles = whole.serials.length;
    this.names = ["time_s", ...(whole.estimated ? [...BY_FRAME, ...BY_TILE] : RAW)];
    const values = whole.estimated ? BY_TILE.length * this.tiles + BY_FRAME.length : this.tiles + 2;
    this.sliceS = Math.round(1e3 * Math.min(SLICE_MOST_S, Math.max(SLICE_LEAST_S, VALUES_IN_SLICE / (values * rateHz)))) * 1e-3;
    this.slices = new Map(); // by number: what came, or the promise of it
    this.notBeforeMs = 0; // after a refusal
  }

  /** The session has grown: what was its end is asked for again. */
  grow(whole) {
    const missing = (bins) => bins.sum("missing", 0, bins.count);
    // Frames that came late have their place between the others, and change what is behind them.
    const settled = missing(whole) < missing(this.whole) ? 0 : this.numberOf(this.whole.durationS - UNSETTLED_S);
    for (const number of [...this.slices.keys()]) if (number >= settled) this.slices.delete(number);
    this.whole = whole;
  }

  /**
   * The frame of an instant: the nearest one, unless it is too far away.
   * @returns {{known: boolean, frame: Frame | null}} not known: it is on its way
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
      const next = placeOf(slice.timeS, timeS);
      for (const row of [next - 1, next]) {
        const apart = Math.abs(slice.timeS[row] - timeS);
        if (apart <= APART_S && !(best?.apart <= apart)) best = { apart, slice, row };
      }
    }
    return { known, frame: known && best ? frameOf(best.slice, best.row, this.tiles) : null };
  }

  /** How far an instant is from the nearer end of its slice. */
  toEdge(timeS) {
    const into = timeS - this.numberOf(timeS) * this.sliceS;
    return Math.min(into, this.sliceS - into);
  }

  /** Slices begin at whole nanoseconds: so both sides have a frame in the same one. */
  numberOf(timeS) {
    const place = (s) => Math.floor(Math.round(s * 1e9) / Math.round(this.sliceS * 1e9));
    return Math.min(place(this.whole.durationS), Math.max(0, place(timeS)));
  }

  /** Ask for what is about an instant, and for some time behind it. */
  want(timeS, aheadS) {
    const [first, now] = [this.numberOf(timeS - APART_S), this.numberOf(timeS)];
    const last = Math.min(this.numberOf(timeS + Math.max(APART_S, aheadS)), now + KEPT - 4);
    const wanted = [now, ...Array.from({ length: last - first + 1 }, (_, i) => first + i).filter((n) => n !== now)];
    this.forgetBut(wanted, now);
    for (const number of wanted) {
      if (this.asking >= AT_ONCE || performance.now() < this.notBeforeMs) return;
      if (!this.slices.has(number)) this.load(number).catch(this.tell.failed);
    }
  }

  get asking() { return [...this.slices.values()].filter((slice) => slice instanceof Promise).length; }

  /** Is all that `want` asks for there? */
  has(timeS, aheadS) {
    for (let n = this.numberOf(timeS); n <= this.numberOf(timeS + aheadS); n++) if (!this.slices.get(n)?.timeS) return false;
    return true;
  }

  forgetBut(wanted, now) {
    const others = [...this.slices.keys()].filter((number) => !wanted.includes(number) && this.slices.get(number).timeS);
    others.sort((a, b) => Math.abs(b - now) - Math.abs(a - now));
    for (const number of others.slice(0, Math.max(0, this.slices.size - KEPT))) this.slices.delete(number);
  }

  /** @returns {Promise<{timeS: Float64Array, columns: Record<string, Float64Array>}>} */
  load(number) {
    const kept = this.slices.get(number);
    if (kept) return Promise.resolve(kept);
    const asked = this.ask(number).then((slice) => {
      if (this.slices.get(number) === asked) this.slices.set(number, slice); // else it has grown meanwhile
      this.tell.come();
      return slice;
    }, (error) => {
      this.slices.delete(number);
      this.notBeforeMs = performance.now() + AGAIN_MS;
      throw error;
    });
    this.slices.set(number, asked);
    return asked;
  }

  async ask(number) {
    const columns = columnsOf(await api.samples(this.id, {
      columns: this.names.join(","), start_s: number * this.sliceS, end_s: (number + 1) * this.sliceS,
    }));
    return { timeS: columns.time_s, columns };
  }

  /**
   * The instant of the frame that is so many frames behind the nearest one to an instant, or before it;
   * at the session's ends, that of its first or last frame.
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

  /** The next slice that has frames; null: there is none. */
  after(number) {
    const { first, last } = this.whole;
    const edgeS = (number + 1) * this.sliceS;
    const bin = placeOf(last, edgeS);
    return bin < last.length ? Math.max(number + 1, this.numberOf(first[bin])) : null;
  }

  before(number) {
    const { first, last } = this.whole;
    const bin = placeOf(first, number * this.sliceS) - 1;
    return bin >= 0 && number > 0 ? Math.min(number - 1, this.numberOf(last[bin])) : null;
  }
}

/** Of a rising list, the place of what is nearest to a value. */
function nearest(list, value) {
  const next = placeOf(list, value);
  return next === list.length || (next > 0 && value - list[next - 1] <= list[next] - value) ? next - 1 : next;
}
