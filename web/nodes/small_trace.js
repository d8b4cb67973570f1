// GRF of the last 10 s on a card: line of latest values, min-max band.

import { coloursOf, crisp, fit } from "../common/axes.js";
import { History } from "../live/history.js";
import { fillBand, Points, runs } from "../live/points.js";
import { autoScale } from "../live/range.js";

const WINDOW_S = 10;
const [LEFT_PX, RIGHT_PX, TOP_PX, BOTTOM_PX] = [46, 4, 8, 6];

/** GRF strip of a card. */
export class SmallTrace {
  /** @param {HTMLCanvasElement} canvas @param {() => string} stream stream_id on display */
  constructor(canvas, stream) {
    this.canvas = canvas;
    this.points = new Points();
    this.history = new History(this.points, stream);
    this.top = autoScale();
    this.colours = null;
  }

  /** Read the colours again. */
  recolour() {
    this.colours = null;
  }

  /** Clear the strip: the node started another stream. */
  clear() {
    this.points.clear();
    this.history.request();
  }

  add(node, frame, nowMs) {
    this.points.periodS = 1 / (node.nominal_rate_hz || 400);
    this.points.add(frame, nowMs);
    this.history.update(node, frame, WINDOW_S, nowMs, null);
  }

  draw(nowMs) {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (!width || !height) return;
    this.colours ??= coloursOf(this.canvas, ["text", "grid", "soft", "fill", "band", "warn-line"]);
    const { colours } = this;
    const context = fit(this.canvas, width, height);
    const endS = this.points.all.at(-1)?.timeS ?? 0;
    const points = this.points.all.filter(({ timeS }) => timeS > endS - WINDOW_S);
    this.top.update(points.flatMap(({ high, bound }) => [high, bound]), nowMs);
    const top = this.top.value;
    const box = { left: LEFT_PX, right: width - RIGHT_PX, top: TOP_PX, bottom: height - BOTTOM_PX };
    const x = (timeS) => box.right - ((endS - timeS) / WINDOW_S) * (box.right - box.left);
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
    for (const run of runs(points, (point) => point.high)) fillBand(context, run, x, y, (point) => point.low, (point) => point.high);
    context.lineWidth = 1.5;
    context.lineJoin = "round";
    // Dashed: lower bound.
    for (const [colour, dashes, valueOf] of /** @type {[string, number[], (point: any) => number][]} */ ([
      [colours.fill, [], (point) => point.grf], [colours["warn-line"], [5, 3], (point) => point.bound],
    ])) {
      context.strokeStyle = colour;
      context.setLineDash(dashes);
      for (const run of runs(points, valueOf)) {
        context.beginPath();
        for (const point of run) context.lineTo(x(point.timeS), y(valueOf(point)));
        context.stroke();
      }
    }
    context.setLineDash([]);
  }
}
