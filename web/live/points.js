// What the trace is drawn from: spans of frames in the order of their numbers, a minute of them.
//
// A span comes with a live message, or many at once with what the server remembers of the time
// before; both say which numbers they are of, so that nothing is there twice and a gap is a gap.

const KEPT_S = 61;
const MOST = 4000; // a minute at 30 Hz are 1800; the rest guards against a server gone wild
const LATE_S = 0.1; // no number is missing, and yet no frame was taken for so long

const FIELDS = ["seq_first", "seq", "n", "t_ns", "grf_n", "grf_min_n", "grf_max_n", "grf_at_least_max_n"];

export class Points {
  constructor() {
    this.periodS = 1 / 400;
    this.clear();
  }

  clear() {
    this.all = [];
    this.tilesPast = []; // each tile, before the first live message that has it
    this.offsetS = null; // page clock minus sample clock
  }

  /** A live message. */
  add(frame, nowMs) {
    const point = pointOf(frame);
    point.tiles = frame; // of each tile: only live messages have it
    const last = this.all.at(-1);
    if (last && (point.seq <= last.seq || point.timeS <= last.timeS)) this.clear(); // the node restarted
    // The smallest delay seen is the steadiest clock: jitter of the network must not shake the line.
    const offsetS = nowMs / 1000 - point.timeS;
    if (this.offsetS === null || offsetS < this.offsetS || offsetS - this.offsetS > 2) this.offsetS = offsetS;
    else this.offsetS += 0.01 * (offsetS - this.offsetS);
    point.gap = this.isGap(this.all.at(-1), point);
    this.all.push(point);
    this.trim();
  }

  /**
   * What the server remembers, up to number `before`; what was heard from there on follows it.
   * Without `before` nothing was heard yet.
   */
  precede(recent, before, nowMs) {
    const past = recent.seq.map((_, i) => pointOf(Object.fromEntries(FIELDS.map((name) => [name, recent[name][i]]))));
    if (!past.length) return;
    const older = this.all.filter((point) => point.seq < past[0].seqFirst);
    const newer = this.all.filter((point) => point.seqFirst >= (before ?? Infinity));
    this.all = [...older, ...past, ...newer];
    this.all.forEach((point, i) => { point.gap = this.isGap(this.all[i - 1], point); });
    this.offsetS ??= nowMs / 1000 - past.at(-1).timeS - (recent.age_ms ?? 0) / 1000;
    this.trim();
  }

  /** The same of each tile: least and greatest of `unit`, as the server says of a tenth of a second each. */
  precedeTiles(recent, unit, before) {
    const [low, high] = ["min", "max"].map((which) => unit.replace("_", `_${which}_`));
    this.tilesPast = recent.seq.map((seq, i) => ({
      seqFirst: recent.seq_first[i], seq, n: recent.n[i], timeS: recent.t_ns[i] / 1e9,
      tiles: { [low]: recent.min[i], [high]: recent.max[i] },
    }));
    this.tilesPast.forEach((point, i) => { point.gap = this.isGap(this.tilesPast[i - 1], point); });
    for (const point of this.all) if (point.seq < (before ?? Infinity)) point.tiles = null; // these are there now
  }

  isGap(before, point) {
    return !before || point.seqFirst > before.seq + 1 || point.n < point.seq - point.seqFirst + 1
      || point.timeS - before.timeS > LATE_S + 1.5 * point.n * this.periodS;
  }

  trim() {
    const oldestS = this.all.at(-1).timeS - KEPT_S;
    let old = Math.max(0, this.all.length - MOST);
    while (this.all[old].timeS < oldestS) old++;
    if (old) this.all.splice(0, old);
  }
}

/** Unbroken stretches of points in which there is a value: a gap in the data is a gap in the line. */
export function* runs(points, valueOf) {
  let run = [];
  for (const point of points) {
    const absent = !Number.isFinite(valueOf(point));
    if ((point.gap || absent) && run.length) {
      yield run;
      run = [];
    }
    if (!absent) run.push(point);
  }
  if (run.length) yield run;
}

const pointOf = (span) => ({
  seqFirst: span.seq_first, seq: span.seq, n: span.n, timeS: span.t_ns / 1e9, gap: true,
  grf: span.grf_n, low: span.grf_min_n, high: span.grf_max_n,
  // Where there is no force there may be a bound. A foot does not pull: one below zero is one of zero.
  bound: Number.isFinite(span.grf_at_least_max_n) ? Math.max(0, span.grf_at_least_max_n) : null,
});
