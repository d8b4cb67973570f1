// The ground reaction force of the last ten seconds, drawn at display rate on a canvas.

import { byId, setText } from "../common/text.js";

const WINDOW_S = 10;
const MOST_POINTS = 2000; // 10 s at 30 Hz are 300; the rest guards against a server gone wild
const STEPS_N = [1, 2, 3, 4, 5, 10, 15, 20, 30, 50, 100, 200, 500, 1000, 2000, 5000, 10000];
const SHRINK_AFTER_MS = 4000; // a scale that follows every step of the robot cannot be read

export class Trace {
  constructor() {
    this.canvas = byId("trace");
    this.context = this.canvas.getContext("2d");
    this.still = matchMedia("(prefers-reduced-motion: reduce)");
    this.drawnMs = 0;
    this.stepN = 5;
    this.fitsSmallerSinceMs = null;
    this.clear();
    new ResizeObserver(() => this.resize()).observe(this.canvas);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { this.colours = null; });
  }

  clear() {
    this.points = [];
    this.offsetS = null; // page clock minus sample clock
    this.droppedTo = null;
  }

  resize() {
    const ratio = devicePixelRatio || 1;
    this.ratio = ratio;
    this.canvas.width = Math.round(this.canvas.clientWidth * ratio);
    this.canvas.height = Math.round(this.canvas.clientHeight * ratio);
    this.drawnMs = 0;
  }

  /** Frames `from`..`to` were never shown: the line must not run across them. */
  dropped(fromSeq, toSeq) {
    const next = this.points.find((point) => point.seq > toSeq);
    if (next) next.gap = true;
    else this.droppedTo = toSeq;
  }

  add(frame, nominalHz, nowMs) {
    const timeS = frame.t_ns / 1e9;
    const last = this.points.at(-1);
    const periodS = 1 / (nominalHz || 400);
    if (last && (frame.seq <= last.seq || timeS <= last.timeS)) this.clear(); // the node restarted
    // The smallest delay seen is the steadiest clock: jitter of the network must not shake the line.
    const offsetS = nowMs / 1000 - timeS;
    if (this.offsetS === null || offsetS < this.offsetS || offsetS - this.offsetS > 2) this.offsetS = offsetS;
    else this.offsetS += 0.01 * (offsetS - this.offsetS);

    const point = {
      seq: frame.seq, timeS, gap: true, grf: frame.grf_n,
      low: frame.grf_min_n ?? frame.grf_n, high: frame.grf_max_n ?? frame.grf_n,
      // Without a force there may be a bound; one below zero says nothing.
      bound: !Number.isFinite(frame.grf_n) && frame.grf_at_least_n > 0 ? frame.grf_at_least_n : null,
    };
    if (last && this.points.length) {
      const missingS = Math.max(0, frame.seq - frame.n - last.seq) * periodS;
      const lateS = timeS - last.timeS - 1.5 * frame.n * periodS;
      point.gap = missingS > 0.05 || lateS > 0.1 || (this.droppedTo !== null && frame.seq > this.droppedTo);
    }
    this.droppedTo = null;
    this.points.push(point);
    const oldestS = timeS - WINDOW_S - 1;
    let old = 0;
    while (old < this.points.length && this.points[old].timeS < oldestS) old++;
    if (this.points.length - old > MOST_POINTS) old = this.points.length - MOST_POINTS;
    if (old) this.points.splice(0, old);
  }

  /** Up at once, down only after a while: the scale stands still while the foot walks. */
  scale(nowMs) {
    let high = 0;
    let low = 0;
    for (const point of this.points) {
      if (point.high > high) high = point.high;
      if (point.bound > high) high = point.bound;
      if (point.low < low) low = point.low;
    }
    const need = STEPS_N.find((step) => 5 * step >= 1.03 * high && step >= -1.03 * low) ?? STEPS_N.at(-1);
    if (need > this.stepN) this.stepN = need;
    if (need < this.stepN && this.points.length) {
      this.fitsSmallerSinceMs ??= nowMs;
      if (nowMs - this.fitsSmallerSinceMs > SHRINK_AFTER_MS) this.stepN = need;
    } else this.fitsSmallerSinceMs = null;
    return { top: 5 * this.stepN, bottom: -0.6 * this.stepN < 1.03 * low ? -0.6 * this.stepN : -this.stepN };
  }

  draw(nowMs, live) {
    if (this.still.matches && nowMs - this.drawnMs < 200) return;
    this.drawnMs = nowMs;
    if (!this.canvas.width || !this.canvas.height) return;
    if (devicePixelRatio !== this.ratio) this.resize(); // moved to another screen
    if (!this.colours || this.coloursLive !== live) this.readColours(live);
    const { context, ratio, colours } = this;
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    const width = this.canvas.width / ratio;
    const height = this.canvas.height / ratio;
    context.clearRect(0, 0, width, height);

    const { top, bottom } = this.scale(nowMs);
    const box = { left: 50, right: width - 10, top: 8, bottom: height - 24 };
    const endS = this.offsetS === null ? 0 : nowMs / 1000 - this.offsetS;
    const x = (timeS) => box.right - ((endS - timeS) / WINDOW_S) * (box.right - box.left);
    const y = (n) => box.bottom - ((n - bottom) / (top - bottom)) * (box.bottom - box.top);
    this.axes(box, x, y, top, endS, width < 500 ? 2 : 1);

    context.save();
    context.beginPath();
    context.rect(box.left, box.top - 4, box.right - box.left, box.bottom - box.top + 4);
    context.clip();
    for (const run of this.runs((point) => point.grf)) {
      context.fillStyle = colours.band;
      context.beginPath();
      run.forEach((point) => context.lineTo(x(point.timeS), y(point.high)));
      run.toReversed().forEach((point) => context.lineTo(x(point.timeS), y(point.low)));
      context.fill();
      context.strokeStyle = colours.line;
      context.lineWidth = 2;
      context.lineJoin = "round";
      context.beginPath();
      if (run.length === 1) context.arc(x(run[0].timeS), y(run[0].grf), 1, 0, 7); // alone between two gaps
      run.forEach((point) => context.lineTo(x(point.timeS), y(point.grf)));
      context.stroke();
    }
    let someBound = false;
    for (const run of this.runs((point) => point.bound)) {
      someBound = true;
      this.above(run.map((point) => [x(point.timeS), y(point.bound)]), box.top - 4);
    }
    context.restore();
    setText(byId("trace-legend"), "line: newest, band: min to max"
      + (someBound ? ", striped: at least this much" : ""));
  }

  /** A bound: the force is on its line or anywhere in the stripes above. */
  above(line, top) {
    const { context, colours } = this;
    const left = line[0][0] - 1;
    const right = line.at(-1)[0] + 1;
    context.save();
    context.beginPath();
    context.moveTo(left, top);
    context.lineTo(left, line[0][1]);
    line.forEach(([px, py]) => context.lineTo(px, py));
    context.lineTo(right, line.at(-1)[1]);
    context.lineTo(right, top);
    context.clip();
    context.strokeStyle = colours.warn;
    context.lineWidth = 1;
    context.beginPath();
    const height = this.canvas.height;
    for (let at = Math.floor((left - height) / 8) * 8; at < right; at += 8) {
      context.moveTo(at, height);
      context.lineTo(at + height, 0);
    }
    context.globalAlpha = 0.5;
    context.stroke();
    context.restore();
    context.strokeStyle = colours.warn;
    context.lineWidth = 2;
    context.beginPath();
    context.moveTo(left, line[0][1]);
    line.forEach(([px, py]) => context.lineTo(px, py));
    context.lineTo(right, line.at(-1)[1]);
    context.stroke();
  }

  /** Unbroken stretches in which there is a value: a gap in the data is a gap in the line. */
  *runs(valueOf) {
    let run = [];
    for (const point of this.points) {
      const absent = !Number.isFinite(valueOf(point));
      if ((point.gap || absent) && run.length) {
        yield run;
        run = [];
      }
      if (!absent) run.push(point);
    }
    if (run.length) yield run;
  }

  axes(box, x, y, top, endS, everyS) {
    const { context, colours } = this;
    const crisp = (value) => Math.round(value) + 0.5;
    context.font = "600 13px system-ui, sans-serif";
    context.textBaseline = "middle";
    context.textAlign = "right";
        for (let i = 0; i <= 5; i++) {
      const n = (top / 5) * i;
      const row = crisp(y(n));
      context.strokeStyle = i ? colours.grid : colours.text;
      context.lineWidth = 1;
      context.beginPath();
      context.moveTo(box.left, row);
      context.lineTo(box.right, row);
      context.stroke();
      context.fillStyle = colours.text;
      if (i === 5) context.fillText(`${n} N`, box.left - 5, row + 3);
      else context.fillText(String(n), box.left - 5, row);
    }
    context.textBaseline = "alphabetic";
    context.strokeStyle = colours.text;
    context.beginPath();
    context.moveTo(box.left, crisp(box.bottom));
    context.lineTo(box.right, crisp(box.bottom));
    context.stroke();
    for (let back = 0; back <= WINDOW_S; back += everyS) {
      const column = crisp(x(endS - back));
      context.strokeStyle = colours.text;
      context.beginPath();
      context.moveTo(column, box.bottom);
      context.lineTo(column, box.bottom + 4);
      context.stroke();
      context.textAlign = back === 0 ? "right" : "center";
      const label = back === 0 ? "0 s" : `\u2212${back}`;
      context.fillText(label, back === 0 ? box.right + 8 : column, box.bottom + 18);
    }
  }

  readColours(live) {
    const style = getComputedStyle(this.canvas);
    const colour = (name) => style.getPropertyValue(name).trim();
    this.coloursLive = live;
    this.colours = {
      text: colour("--text"), grid: colour("--grid"), warn: colour("--warn-line"),
      line: colour(live ? "--fill" : "--stale"), band: colour(live ? "--band" : "--grid"),
    };
  }
}
