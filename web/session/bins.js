// Bins of a session, from GET /sessions/ID/overview.

/** @typedef {import("./view.js").View} View */

/** Return the first index of a sorted list whose element is not below `value`. */
export function lowerBound(list, value) {
  let [low, high] = [0, list.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (list[middle] < value) low = middle + 1;
    else high = middle;
  }
  return low;
}

const GAP_STEPS = 3.5; // a longer step is a gap, as in a comparison's series

/** Min and max per interval. */
export class Bins {
  /**
   * @param {OverviewView} overview
   * @param {View} covers requested interval
   */
  constructor(overview, covers) {
    this.columns = overview.columns;
    this.first = overview.columns.t_first_s;
    this.last = overview.columns.t_last_s;
    this.count = this.first.length;
    this.framesInBin = overview.frames_in_bin;
    this.durationS = overview.duration_s;
    this.beginNs = overview.begin_t_ns;
    this.axis = overview.time_axis;
    this.serials = overview.serials;
    this.countsFall = overview.counts_fall;
    this.provisional = Boolean(overview.provisional); // not sealed
    this.catching_up = Boolean(overview.catching_up); // estimation is not complete
    this.covers = covers;
    this.estimated = "grf_n_min" in overview.columns;
    /** @type {number | null} */
    this.step = null;
  }

  /** Usual time from one frame to the next, s: the median between bins; infinite: unknown. */
  get stepS() {
    if (this.step !== null) return this.step;
    const steps = [];
    for (let i = 1; i < this.count; i++) if (this.columns.part[i] === this.columns.part[i - 1]) steps.push(this.first[i] - this.last[i - 1]);
    this.step = steps.sort((a, b) => a - b)[steps.length >> 1] ?? Infinity;
    return this.step;
  }

  /** Sampling rate, lost frames included; null: too few frames. */
  get rateHz() {
    let [sampled, lastedS] = [0, 0];
    for (let i = 0, begin = 0; i < this.count; i++) {
      sampled += this.columns.frames[i] + this.columns.missing[i];
      if (i + 1 < this.count && this.columns.part[i + 1] === this.columns.part[i]) continue;
      lastedS += this.last[i] - this.first[begin];
      sampled -= 1; // a part lasts from its first frame to its last
      begin = i + 1;
    }
    return sampled > 0 && lastedS > 0 ? sampled / lastedS : null;
  }

  /** Return a tile's counts at its least (`low`) and most load: each kind of chip has its own scale and sign. */
  countRange(tile) {
    const { low, high } = this.extremes(`pressure_raw_${tile}_min`, `pressure_raw_${tile}_max`, 0, this.count) ?? { low: 0, high: 1 };
    const end = high > low ? high : low + 1;
    return this.countsFall[tile] ? { low: end, high: low } : { low, high: end };
  }

  has(name) { return Boolean(this.columns[name]?.some((value) => value !== null)); }

  contains(view) { return this.covers.from <= view.from && this.covers.to >= view.to; }

  /** Return the index range [begin, end) of the bins in a view. */
  within(view) {
    return [lowerBound(this.last, view.from), lowerBound(this.first, view.to + 1e-9)];
  }

  /** Return the index of the nearest bin; -1: none. */
  at(timeS) {
    if (!this.count) return -1;
    const next = Math.min(this.count - 1, lowerBound(this.last, timeS));
    if (next === 0 || this.first[next] <= timeS) return next;
    return timeS - this.last[next - 1] <= this.first[next] - timeS ? next - 1 : next;
  }

  /** Return the end of a bin: start of an adjacent next bin, else its last frame. */
  edge(i) {
    return i + 1 < this.count && this.isAdjacent(i + 1) ? this.first[i + 1] : this.last[i];
  }

  /** Return true if no frame is missing between a bin and the previous one: lost, or not sampled. */
  isAdjacent(i) {
    return i > 0 && this.columns.part[i] === this.columns.part[i - 1] && this.columns.missing[i] === 0
      && this.first[i] - this.last[i - 1] <= GAP_STEPS * this.stepS;
  }

  /** Return true if an instant is no gap away from the frames of a bin. */
  isAt(i, timeS) {
    return timeS >= this.first[i] - GAP_STEPS * this.stepS && timeS <= this.edge(i) + GAP_STEPS * this.stepS;
  }

  /** Return true if more than half of a bin's time is without frames: where in it is not known. */
  isMostlyGap(i) {
    return this.last[i] - this.first[i] > 2 * this.columns.frames[i] * this.stepS;
  }

  /** Return min of one column, max of another, and the index of the max; null: no values. */
  extremes(lowName, highName, begin, end) {
    const [lows, highs] = [this.columns[lowName], this.columns[highName]];
    let found = null;
    for (let i = begin; i < end; i++) {
      const [low, high] = [lows[i], highs[i]];
      if (low !== null && (found === null || low < found.low)) found = { ...(found ?? { high: -Infinity, at: i }), low };
      if (high !== null && (found === null || high > found.high)) found = { ...(found ?? { low: Infinity }), high, at: i };
    }
    return found && Number.isFinite(found.low) && Number.isFinite(found.high) ? found : null;
  }

  sum(name, begin, end) {
    let total = 0;
    for (let i = begin; i < end; i++) total += this.columns[name][i];
    return total;
  }
}
