// GRF trace on a canvas: drawn again after each half pixel of motion.

import { coloursOf, whenColoursChange } from "../common/axes.js";
import { byId, setData } from "../common/text.js";
import { fillBand, Points, runs } from "./points.js";
import { TraceAxes } from "./trace_axes.js";

const WINDOWS_S = [5, 10, 30, 60];
const WINDOW_KEY = "foottile.window";
const STEPS_N = [1, 2, 3, 4, 5, 10, 15, 20, 30, 50, 100, 200, 500, 1000, 2000, 5000, 10000];
const [LEFT_PX, RIGHT_PX] = [50, 10]; // of the axes
const SHRINK_AFTER_MS = 4000; // longer than a step of the robot

/** GRF over the last seconds. */
export class Trace {
  /** `onWindow()` runs after a change of the window. */
  constructor(onWindow) {
    this.canvas = byId("trace", HTMLCanvasElement);
    this.context = this.canvas.getContext("2d");
    this.axes = new TraceAxes();
    this.still = matchMedia("(prefers-reduced-motion: reduce)");
    this.points = new Points();
    this.held = null; // while paused: points and time of the pause
    this.drawnMs = 0;
    this.stepN = 5;
    this.fitsSmallerSinceMs = null;
    this.choice = byId("trace-window", HTMLSelectElement);
    let stored = null;
    try { stored = localStorage.getItem(WINDOW_KEY); } catch { /* private window */ }
    this.windowS = WINDOWS_S.includes(Number(stored)) ? Number(stored) : 10;
    this.choice.value = String(this.windowS);
    this.choice.addEventListener("change", () => {
      this.windowS = Number(this.choice.value);
      try { localStorage.setItem(WINDOW_KEY, this.choice.value); } catch { /* private window */ }
      this.drawnMs = 0;
      onWindow();
    });
    new ResizeObserver(() => this.resize()).observe(this.canvas);
    whenColoursChange(() => this.recolour());
  }

  recolour() {
    this.colours = null;
    this.drawnMs = 0;
  }

  clear() {
    this.points.clear();
    this.drawnMs = 0;
  }

  resize() {
    const ratio = devicePixelRatio || 1;
    this.ratio = ratio;
    this.canvas.width = Math.round(this.canvas.clientWidth * ratio);
    this.canvas.height = Math.round(this.canvas.clientHeight * ratio);
    this.drawnMs = 0;
  }

  add(frame, nominalHz, nowMs) {
    this.points.periodS = 1 / (nominalHz || 400);
    this.points.add(frame, nowMs);
  }

  /** Hold the picture; points are still added. */
  pause(nowMs) {
    this.held = { points: [...this.points.all], tileHistory: this.points.tileHistory, offsetS: this.points.offsetS, nowMs };
  }

  resume() {
    this.held = null;
    this.drawnMs = 0;
  }

  /** Return the scale: grows at once, shrinks after a delay. */
  scale(points, nowMs) {
    let high = 0;
    let low = 0;
    for (const point of points) {
      if (point.high > high) high = point.high;
      if (point.bound > high) high = point.bound;
      if (point.low < low) low = point.low;
    }
    const need = STEPS_N.find((step) => 5 * step >= 1.03 * high && step >= -1.03 * low) ?? STEPS_N.at(-1);
    if (need > this.stepN) this.stepN = need;
    if (need < this.stepN && points.length) {
      this.fitsSmallerSinceMs ??= nowMs;
      if (nowMs - this.fitsSmallerSinceMs > SHRINK_AFTER_MS) this.stepN = need;
    } else this.fitsSmallerSinceMs = null;
    return { top: 5 * this.stepN, bottom: -0.6 * this.stepN < 1.03 * low ? -0.6 * this.stepN : -this.stepN };
  }

  /** Draw if due; return the points on display, else null. */
  draw(nowMs, live) {
    if (!this.canvas.width || !this.canvas.height) return null;
    if (devicePixelRatio !== this.ratio) this.resize(); // moved to another screen
    const boxPx = this.canvas.width / this.ratio - LEFT_PX - RIGHT_PX;
    const everyMs = this.held ? Infinity
      : this.still.matches ? 200 : (500 * this.windowS) / Math.max(boxPx * this.ratio, 1);
    if (this.drawnMs && this.coloursLive === live && nowMs - this.drawnMs < everyMs) return null;
    this.drawnMs = nowMs;
    if (!this.colours || this.coloursLive !== live) this.readColours(live);
    const { context, ratio, colours, windowS } = this;
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    const width = this.canvas.width / ratio;
    const height = this.canvas.height / ratio;
    context.clearRect(0, 0, width, height);

    const { all, offsetS, atMs } = this.held
      ? { all: this.held.points, offsetS: this.held.offsetS, atMs: this.held.nowMs }
      : { all: this.points.all, offsetS: this.points.offsetS, atMs: nowMs };
    const endS = offsetS === null ? 0 : atMs / 1000 - offsetS;
    const first = all.findIndex((point) => point.timeS > endS - windowS);
    const points = first < 0 ? [] : all.slice(Math.max(0, first - 1)); // one more, up to the edge
    const { top, bottom } = this.scale(points, nowMs);
    const box = { left: LEFT_PX, right: width - RIGHT_PX, top: 8, bottom: height - 24 };
    const x = (timeS) => box.right - ((endS - timeS) / windowS) * (box.right - box.left);
    const y = (n) => box.bottom - ((n - bottom) / (top - bottom)) * (box.bottom - box.top);
    this.axes.draw({ width, height, ratio }, box, { top, bottom, windowS }, colours);

    context.save();
    context.beginPath();
    context.rect(box.left, box.top - 4, box.right - box.left, box.bottom - box.top + 4);
    context.clip();
    // Band alone: shows a peak even if the latest frame of its span has no force.
    context.fillStyle = colours.band;
    for (const run of runs(points, (point) => point.high)) fillBand(context, run, x, y, (point) => point.low, (point) => point.high);
    context.strokeStyle = colours.line;
    context.lineWidth = 2;
    context.lineJoin = "round";
    for (const run of runs(points, (point) => point.grf)) {
      context.beginPath();
      if (run.length === 1) context.arc(x(run[0].timeS), y(run[0].grf), 1, 0, 7); // alone between two gaps
      run.forEach((point) => context.lineTo(x(point.timeS), y(point.grf)));
      context.stroke();
    }
    let someBound = false;
    for (const run of runs(points, (point) => point.bound)) {
      someBound = true;
      this.drawBound(run.map((point) => [x(point.timeS), y(point.bound)]), box.top - 4);
    }
    context.restore();
    setData(byId("trace-legend"), "bound", String(someBound));
    return { points, tileHistory: (this.held ?? this.points).tileHistory, endS, windowS, live };
  }

  /** Draw a lower bound: line, and hatching above. */
  drawBound(line, top) {
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
    context.globalAlpha = 0.4;
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

  readColours(live) {
    this.coloursLive = live;
    const { text, grid, stale, fill, band, "warn-line": warn } = coloursOf(this.canvas, ["text", "grid", "stale", "fill", "band", "warn-line"]);
    this.colours = { text, grid, warn, line: live ? fill : stale, band: live ? band : grid };
  }
}
