// Axes of the GRF trace, on a canvas of their own that is drawn only after a change.

import { crisp, fit } from "../common/axes.js";
import { byId } from "../common/text.js";

const TICKS_S = { 5: 1, 10: 1, 30: 5, 60: 10 };

/** Axes behind the trace. */
export class TraceAxes {
  constructor() {
    this.canvas = byId("trace-axes", HTMLCanvasElement);
    this.key = "";
  }

  /**
   * @param {{width: number, height: number, ratio: number}} size in pixels
   * @param {{left: number, right: number, top: number, bottom: number}} box
   * @param {{top: number, bottom: number, windowS: number}} scale in newtons, window in seconds
   * @param {Record<string, string>} colours
   */
  draw(size, box, { top, bottom, windowS }, colours) {
    const key = [size.width, size.height, size.ratio, top, bottom, windowS, colours.text, colours.grid].join();
    if (key === this.key) return;
    this.key = key;
    const context = fit(this.canvas, size.width, size.height);
    const x = (backS) => box.right - (backS / windowS) * (box.right - box.left);
    const y = (n) => box.bottom - ((n - bottom) / (top - bottom)) * (box.bottom - box.top);
    context.font = "600 13px system-ui, sans-serif";
    context.lineWidth = 1;
    drawRows(context, box, y, top, colours);
    context.textBaseline = "alphabetic";
    context.strokeStyle = colours.text;
    line(context, box.left, crisp(box.bottom), box.right, crisp(box.bottom));
    const everyS = size.width < 500 && windowS === 10 ? 2 : TICKS_S[windowS];
    for (let backS = 0; backS <= windowS; backS += everyS) {
      const column = crisp(x(backS));
      line(context, column, box.bottom, column, box.bottom + 4);
      context.textAlign = backS === 0 ? "right" : "center";
      context.fillText(backS === 0 ? "0 s" : `\u2212${backS}`, backS === 0 ? box.right + 8 : column, box.bottom + 18);
    }
  }
}

function drawRows(context, box, y, top, colours) {
  context.textBaseline = "middle";
  context.textAlign = "right";
  const isLow = y(0) - y(top / 5) < 15;
  for (let i = 0; i <= 5; i++) {
    const n = (top / 5) * i;
    const row = crisp(y(n));
    context.strokeStyle = i ? colours.grid : colours.text;
    line(context, box.left, row, box.right, row);
    if (isLow && i % 5 && i !== 3) continue; // no room for each of them
    context.fillStyle = colours.text;
    if (i === 5) context.fillText(`${n} N`, box.left - 5, row + 3);
    else context.fillText(String(n), box.left - 5, row);
  }
}

function line(context, x0, y0, x1, y1) {
  context.beginPath();
  context.moveTo(x0, y0);
  context.lineTo(x1, y1);
  context.stroke();
}
