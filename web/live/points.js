// Points of the trace: spans of frames in the order of their numbers, one minute.
//
// A span comes with a live message; history brings many. Both state their frame numbers, so that no
// span occurs twice and a gap stays a gap.

const STORED_S = 61;
const POINTS_MAX = 4000; // a minute at 30 Hz: 1800
const GAP_STEPS = 3.5; // a step longer than this many usual ones is a gap, as on a session's page
const STEPS_MAX = 60; // of the newest spans, for the usual step

const FIELDS = ["seq_first", "seq", "n", "t_ns", "grf_n", "grf_min_n", "grf_max_n", "grf_lower_bound_max_n"];

/** Points of the GRF trace, and of each tile. */
export class Points {
  constructor() {
    this.periodS = 1 / 400;
    this.clear();
  }

  clear() {
    this.all = [];
    this.tileHistory = []; // each tile, before its first live message
    this.offsetS = null; // page clock minus sample clock
  }

  /** Add a live message. */
  add(frame, nowMs) {
    const point = pointOf(frame);
    point.tiles = frame; // only live messages contain tiles
    const last = this.all.at(-1);
    if (last && (point.seq <= last.seq || point.timeS <= last.timeS)) this.clear(); // the node restarted
    // The smallest delay is the steadiest clock: network jitter must not shake the line.
    const offsetS = nowMs / 1000 - point.timeS;
    if (this.offsetS === null || offsetS < this.offsetS || offsetS - this.offsetS > 2) this.offsetS = offsetS;
    else this.offsetS += 0.01 * (offsetS - this.offsetS);
    noteGap(this.all.at(-1), point, this.usualStepS(this.all.slice(-STEPS_MAX)));
    this.all.push(point);
    this.trim();
  }

  /**
   * Insert history up to frame number `before`; live points follow.
   * Without `before` there are no live points yet.
   */
  addHistory(recent, before, nowMs) {
    const past = recent.seq.map((_, i) => pointOf(Object.fromEntries(FIELDS.map((name) => [name, recent[name][i]]))));
    if (!past.length) return;
    const older = this.all.filter((point) => point.seq < past[0].seqFirst);
    const newer = this.all.filter((point) => point.seqFirst >= (before ?? Infinity));
    this.all = [...older, ...past, ...newer];
    this.noteGaps(this.all);
    this.offsetS ??= nowMs / 1000 - past.at(-1).timeS - (recent.age_ms ?? 0) / 1000;
    this.trim();
  }

  /** Insert history of each tile: min and max of column `unit` per 0.1 s. */
  addTileHistory(recent, unit, before) {
    const [low, high] = ["min", "max"].map((which) => unit.replace("_", `_${which}_`));
    this.tileHistory = recent.seq.map((seq, i) => ({
      seqFirst: recent.seq_first[i], seq, n: recent.n[i], timeS: recent.t_ns[i] / 1e9, fromS: recent.t_ns[i] / 1e9, gap: true,
      tiles: { [low]: recent.min[i], [high]: recent.max[i] },
    }));
    this.noteGaps(this.tileHistory);
    for (const point of this.all) if (point.seq < (before ?? Infinity)) point.tiles = null; // covered by the history
  }

  noteGaps(points) {
    const stepS = this.usualStepS(points);
    points.forEach((point, i) => noteGap(points[i - 1], point, stepS));
  }

  /** Return the usual time from frame to frame: a late node's is longer than the nominal one. */
  usualStepS(points) {
    const steps = [];
    for (let i = 1; i < points.length; i++) {
      if (points[i].seqFirst === points[i - 1].seq + 1) steps.push((points[i].timeS - points[i - 1].timeS) / points[i].n);
    }
    return Math.max(this.periodS, steps.sort((a, b) => a - b)[steps.length >> 1] ?? 0);
  }

  trim() {
    const oldestS = this.all.at(-1).timeS - STORED_S;
    let old = Math.max(0, this.all.length - POINTS_MAX);
    while (this.all[old].timeS < oldestS) old++;
    if (old) this.all.splice(0, old);
  }
}

/** Note whether frames are missing before a point, or in it, lost or not sampled, and where its span begins. */
function noteGap(before, point, stepS) {
  point.gap = !before || point.seqFirst > before.seq + 1 || point.n < point.seq - point.seqFirst + 1
    || point.timeS - before.timeS > (1.5 * point.n + GAP_STEPS) * stepS;
  const fromS = point.timeS - (point.n - 1) * stepS;
  point.fromS = !before ? fromS : point.gap ? Math.max(before.timeS, fromS) : before.timeS;
}

/** Fill the band of a run from min to max, each over its own span. */
export function fillBand(context, run, x, y, lowOf, highOf) {
  context.beginPath();
  for (const point of run) {
    context.lineTo(x(point.fromS), y(highOf(point)));
    context.lineTo(x(point.timeS), y(highOf(point)));
  }
  for (const point of [...run].reverse()) {
    context.lineTo(x(point.timeS), y(lowOf(point)));
    context.lineTo(x(point.fromS), y(lowOf(point)));
  }
  context.fill();
  const [{ fromS, timeS }] = run;
  if (run.length === 1 && x(timeS) - x(fromS) < 2) { // alone between two gaps
    const top = y(highOf(run[0]));
    context.fillRect(x(timeS) - 1, top, 2, Math.max(1, y(lowOf(run[0])) - top));
  }
}

/** Yield runs of points with a value and without a gap. */
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
  fromS: span.t_ns / 1e9, grf: span.grf_n, low: span.grf_min_n, high: span.grf_max_n,
  // Lower bound where there is no force. A foot does not pull: never below zero.
  bound: Number.isFinite(span.grf_lower_bound_max_n) ? Math.max(0, span.grf_lower_bound_max_n) : null,
});
