// Bins of a session as GET /sessions/ID/overview answers, and what they say of some time.

/** @typedef {import("./view.js").View} View */

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

export class Bins {
  /**
   * @param {Overview} overview
   * @param {View} covers the time that was asked for
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
    this.provisional = Boolean(overview.provisional); // it is not sealed yet
    this.behind = Boolean(overview.behind); // there are more frames than these
    this.covers = covers;
    this.estimated = "grf_n_min" in overview.columns;
  }

  /** Frames that were taken a second, those that were lost among them; null of too few. */
  get rateHz() {
    let [taken, lastedS] = [0, 0];
    for (let i = 0, begin = 0; i < this.count; i++) {
      taken += this.columns.frames[i] + this.columns.missing[i];
      if (i + 1 < this.count && this.columns.part[i + 1] === this.columns.part[i]) continue;
      lastedS += this.last[i] - this.first[begin];
      taken -= 1; // a part lasts from its first frame to its last
      begin = i + 1;
    }
    return taken > 0 && lastedS > 0 ? taken / lastedS : null;
  }

  has(name) { return Boolean(this.columns[name]?.some((value) => value !== null)); }

  contains(view) { return this.covers.from <= view.from && this.covers.to >= view.to; }

  /** Bins that have something of this time: from, up to but not including. */
  within(view) {
    return [placeOf(this.last, view.from), placeOf(this.first, view.to + 1e-9)];
  }

  /** The bin nearest to an instant; -1 if there is none. */
  at(timeS) {
    if (!this.count) return -1;
    const next = Math.min(this.count - 1, placeOf(this.last, timeS));
    if (next === 0 || this.first[next] <= timeS) return next;
    return timeS - this.last[next - 1] <= this.first[next] - timeS ? next - 1 : next;
  }

  /** Where a bin's column ends: at the next one, or with its last frame if that is not its neighbour. */
  edge(i) {
    return i + 1 < this.count && this.follows(i + 1) ? this.first[i + 1] : this.last[i];
  }

  /** No frame is missing between this bin and the one before it, as far as is known. */
  follows(i) {
    return i > 0 && this.columns.part[i] === this.columns.part[i - 1] && this.columns.missing[i] === 0;
  }

  /** Least of one column and greatest of another, and where that is; null if nothing is known. */
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
