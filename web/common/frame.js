// Frame of a small plot: grid, ticks, titles, units.

import { crisp, decimalsOf, ticks } from "./axes.js";
import { number } from "./text.js";

export const FONT = "600 12px system-ui, sans-serif";
export const FRAME_COLOURS = ["page", "text", "soft", "edge", "grid", "series", "other", "interval", "cop", "heat-1", "heat-2", "heat-3"];

/** @typedef {{left: number, right: number, top: number, bottom: number}} Box */
/** @typedef {{low: number, high: number}} Range */

/** Return a range with a margin. @returns {Range} */
export function roomy({ low, high }, share = 0.06) {
  if (!(high >= low)) return { low: 0, high: 1 };
  const room = Math.max(share * (high - low), 1e-9, high === low ? 0.5 : 0);
  return { low: low === 0 ? 0 : low - room, high: high + room };
}

/**
 * Draw the frame of a plot; return the functions from values to pixels.
 * @param {CanvasRenderingContext2D} context
 * @param {Box} box
 * @param {{x: Range, y: Range, colours: Record<string, string>, xTitle?: string, yTitle?: string, xUnit?: string}} how
 */
export function drawFrame(context, box, { x: xs, y: ys, colours, xTitle = "", yTitle = "", xUnit = "" }) {
  const x = (value) => box.left + ((value - xs.low) / (xs.high - xs.low)) * (box.right - box.left);
  const y = (value) => box.bottom - ((value - ys.low) / (ys.high - ys.low)) * (box.bottom - box.top);
  context.font = FONT;
  context.lineWidth = 1;
  context.fillStyle = colours.text;
  const rows = ticks(ys.low, ys.high, Math.max(2, Math.floor((box.bottom - box.top) / 30)));
  context.textAlign = "right";
  context.textBaseline = "middle";
  for (const value of rows.values) {
    line(context, box.left, crisp(y(value)), box.right, crisp(y(value)), Math.abs(value) < 1e-6 * rows.step ? colours.edge : colours.grid);
    context.fillText(number(value, decimalsOf(rows.step)), box.left - 6, y(value));
  }
  const columns = ticks(xs.low, xs.high, Math.max(2, Math.floor((box.right - box.left) / 60)));
  context.textAlign = "center";
  context.textBaseline = "top";
  for (const [i, value] of columns.values.entries()) {
    line(context, crisp(x(value)), box.bottom, crisp(x(value)), box.bottom + 5, colours.edge);
    const unit = i === columns.values.length - 1 && xUnit ? ` ${xUnit}` : "";
    const text = number(value, decimalsOf(columns.step)) + unit;
    const half = context.measureText(text).width / 2; // stay on the canvas
    context.fillText(text, Math.min(x(value), context.canvas.clientWidth - half - 1), box.bottom + 8);
  }
  line(context, crisp(box.left), box.top, crisp(box.left), box.bottom, colours.edge);
  line(context, box.left, crisp(box.bottom), box.right, crisp(box.bottom), colours.edge);
  context.fillStyle = colours.soft;
  if (xTitle) context.fillText(xTitle, (box.left + box.right) / 2, box.bottom + 23);
  context.textAlign = "left";
  if (yTitle) context.fillText(yTitle, box.left, box.top - 16);
  return { x, y };
}

function line(context, x0, y0, x1, y1, colour) {
  context.strokeStyle = colour;
  context.beginPath();
  context.moveTo(x0, y0);
  context.lineTo(x1, y1);
  context.stroke();
}

/** Draw a line; null interrupts it. */
export function drawCurve(context, xs, ys) {
  context.beginPath();
  let on = false;
  for (let i = 0; i < ys.length; i++) {
    if (ys[i] === null || xs[i] === null) { on = false; continue; }
    if (on) context.lineTo(xs[i], ys[i]);
    else context.moveTo(xs[i], ys[i]);
    on = true;
  }
  context.stroke();
}

/** Draw the area between two lines; null interrupts it. */
export function drawArea(context, xs, lows, highs) {
  let start = -1;
  for (let i = 0; i <= xs.length; i++) {
    const known = i < xs.length && lows[i] !== null && highs[i] !== null;
    if (known && start < 0) start = i;
    if (known || start < 0) continue;
    context.beginPath();
    for (let k = start; k < i; k++) context.lineTo(xs[k], highs[k]);
    for (let k = i - 1; k >= start; k--) context.lineTo(xs[k], lows[k]);
    context.closePath();
    context.fill();
    start = -1;
  }
}
