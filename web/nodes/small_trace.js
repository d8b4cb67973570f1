// The ground reaction force of the last ten seconds as a strip, on a card: line of the newest, band from min to max.

import { coloursOf, crisp, fit } from "../common/axes.js";
import { History } from "../live/history.js";
import { Points, runs } from "../live/points.js";
import { following } from "../live/range.js";

const WINDOW_S = 10;
const [LEFT_PX, RIGHT_PX, TOP_PX, BOTTOM_PX] = [46, 4, 8, 6];

export class SmallTrace {
  /** @param {HTMLCanvasElement} canvas @param {() => string} stream that is shown now, by its boot_id */
  constructor(canvas, stream) {
    this.canvas = canvas;
    this.points = new Points();
    this.past = new History(this.points, stream);
    this.top = following();
    this.colours = null;
  }

  /** The colours of the page have changed. */
  recolour() {
    this.colours = null;
  }

  /** The node restarted: what is drawn is of another stream. */
  clear() {
    this.points.clear();
    this.past.want();
  }

  add(node, frame, nowMs) {
    this.points.periodS = 1 / (node.nominal_rate_hz || 400);
    this.points.add(frame, nowMs);
    this.past.see(node, frame, WINDOW_S, nowMs, null);
  }

  draw(nowMs) {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (!width || !height) return;
    this.colours ??= coloursOf(this.canvas, ["text", "grid", "soft", "fill", "band", "warn-line"]);
    const { colours } = this;
    const context = fit(this.canvas, width, height);
    const endS = this.points.all.at(-1)?.timeS ?? 0;
    const points = this.points.all.filter(({ timeS }) => timeS > endS - WINDOW_S);
    this.top.see(points.flatMap(({ high, bound }) => [high, bound]), nowMs);
    const top = this.top.value;
    const box = { left: LEFT_PX, right: width - RIGHT_PX, top: TOP_PX, bottom: height - BOTTOM_PX };
    const x = ({ timeS }) => box.right - ((endS - timeS) / WINDOW_S) * (box.right - box.left);
    const y = (n) => Math.min(height, box.bottom - (n / top) * (box.bottom - box.top));
    context.font = "600 12px system-ui, sans-serif";
    context.textAlign = "right";
    context.textBaseline = "middle";
    context.fillStyle = colours.text;
    for (const n of [0, top]) {
      context.strokeStyle = n ? colours.grid : colours.soft;
      context.beginPath();
      context.moveTo(box.left, crisp(y(n)));
      context.lineTo(box.right, crisp(y(n)));
      context.stroke();
      context.fillText(n ? `${n} N` : "0", box.left - 5, Math.min(y(n), height - 7));
    }
    context.fillStyle = colours.band;
    for (const run of runs(points, (point) => point.high)) {
      context.beginPath();
      for (const point of run) context.lineTo(x(point), y(point.high));
      for (const point of [...run].reverse()) context.lineTo(x(point), y(point.low));
      context.fill();
    }
    context.lineWidth = 1.5;
    context.lineJoin = "round";
    // Where no force is known its lower bound is dashed.
    for (const [colour, dashes, valueOf] of /** @type {[string, number[], (point: any) => number][]} */ ([
      [colours.fill, [], (point) => point.grf], [colours["warn-line"], [5, 3], (point) => point.bound],
    ])) {
      context.strokeStyle = colour;
      context.setLineDash(dashes);
      for (const run of runs(points, valueOf)) {
        context.beginPath();
        for (const point of run) context.lineTo(x(point), y(valueOf(point)));
        context.stroke();
      }
    }
    context.setLineDash([]);
  }
}
