// Each tile over the last seconds: rows of traces, or of colours where there are too many for that.

import { shadeOf, shadesOf } from "../common/heat.js";
import { byId, number } from "../common/text.js";
import { runs } from "./points.js";
import { unitOf } from "./tile.js";

const KEY = "foottile.tiles-as";
const EVERY_MS = 60; // many rows cost more than one
const ROW_PX = 16; // less has no room for a trace
const [LEFT_PX, RIGHT_PX] = [50, 10]; // as the trace of the force above

export class TileTraces {
  /** @param {import("./range.js").Range} range @param {() => void} onChange */
  constructor(range, onChange) {
    this.range = range;
    this.canvas = byId("tile-traces", HTMLCanvasElement);
    this.context = this.canvas.getContext("2d");
    this.shown = false;
    this.drawnMs = 0;
    try { this.shown = localStorage.getItem(KEY) === "traces"; } catch { /* private window */ }
    const choose = (shown) => {
      this.shown = shown;
      this.drawnMs = 0;
      try { localStorage.setItem(KEY, shown ? "traces" : "bars"); } catch { /* private window */ }
      this.show();
      onChange();
    };
    byId("as-bars").addEventListener("click", () => choose(false));
    byId("as-traces").addEventListener("click", () => choose(true));
    this.show();
  }

  /** What of each tile is drawn, as the API calls it; null: they are not shown so. */
  wants(unit) {
    if (!this.shown) return null;
    return unit === "N" ? "force_n" : "gauge_kpa";
  }

  show() {
    byId("as-bars").setAttribute("aria-pressed", String(!this.shown));
    byId("as-traces").setAttribute("aria-pressed", String(this.shown));
    byId("bars").hidden = byId("bars-legend").hidden = this.shown;
    this.canvas.hidden = !this.shown;
  }

  /**
   * @param {{tiles: Tile[]}} node
   * @param {{points: TilePoint[], tilesPast: TilePoint[], endS: number, windowS: number, live: boolean}} seen what the force is drawn of
   * @param {number} nowMs
   * @param {string} unitChosen
   */
  draw(node, { points, tilesPast, endS, windowS, live }, nowMs, unitChosen) {
    if (!this.shown || nowMs - this.drawnMs < EVERY_MS) return;
    this.drawnMs = nowMs;
    const { canvas, context } = this;
    const ratio = devicePixelRatio || 1;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (!width || !height) return;
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      [canvas.width, canvas.height] = [Math.round(width * ratio), Math.round(height * ratio)];
    }
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    this.range.see(node, points.at(-1)?.tiles, nowMs);
    const style = getComputedStyle(canvas);
    const colours = Object.fromEntries(["text", "grid", "fill", "band", "stale", "edge"].map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
    if (!live) colours.fill = colours.band = colours.stale;
    const rowPx = height / node.tiles.length;
    const shades = rowPx < ROW_PX ? shadesOf(canvas) : null;
    const x = (timeS) => width - RIGHT_PX - ((endS - timeS) / windowS) * (width - RIGHT_PX - LEFT_PX);
    const heard = points.filter((point) => point.tiles);
    const known = [...tilesPast.filter((point) => point.timeS > endS - windowS), ...heard];
    context.font = `600 ${Math.min(13, Math.max(8, rowPx - 2))}px system-ui, sans-serif`;
    node.tiles.forEach((tile, i) => {
      const unit = unitOf(tile, unitChosen);
      const top = i * rowPx;
      const most = this.range.of(tile, unit);
      const of = (point, which) => point.tiles[unit === "N" ? `force_${which}n` : `gauge_${which}kpa`]?.[i] ?? null;
      context.fillStyle = colours.text;
      context.textAlign = "right";
      context.textBaseline = "middle";
      if (rowPx >= 9 || i % 4 === 0) context.fillText(tile.serial, LEFT_PX - 5, top + rowPx / 2);
      context.save();
      context.beginPath();
      context.rect(LEFT_PX, top, width - RIGHT_PX - LEFT_PX, rowPx);
      context.clip();
      if (shades) this.colours(known, of, x, top, rowPx, most, shades);
      else this.trace(known, of, x, top, rowPx, most, colours);
      context.restore();
      if (shades) return;
      context.fillStyle = colours.text;
      context.textAlign = "left";
      context.textBaseline = "top";
      if (rowPx >= 26) context.fillText(`${number(most, most < 10 && most % 1 ? 1 : 0)} ${unit}`, LEFT_PX + 3, top + 3);
    });
  }

  trace(points, of, x, top, rowPx, most, colours) {
    const { context } = this;
    const y = (value) => top + rowPx - 2 - (Math.max(-0.1, value / most) + 0.1) / 1.1 * (rowPx - 4);
    context.fillStyle = colours.grid;
    context.fillRect(LEFT_PX, top + rowPx - 1, 1e4, 1);
    context.fillRect(LEFT_PX, Math.round(y(0)), 1e4, 1);
    context.fillStyle = colours.band;
    for (const run of runs(points, (point) => of(point, "max_"))) {
      context.beginPath();
      run.forEach((point) => context.lineTo(x(point.timeS), y(of(point, "max_"))));
      run.toReversed().forEach((point) => context.lineTo(x(point.timeS), y(of(point, "min_"))));
      context.fill();
    }
    context.strokeStyle = colours.fill;
    context.lineWidth = 1.5;
    // Of the time before, least and greatest are known, and not which came last.
    for (const run of runs(points, (point) => (of(point, "") === null ? of(point, "max_") : null))) {
      for (const which of ["max_", "min_"]) {
        context.beginPath();
        run.forEach((point) => context.lineTo(x(point.timeS), y(of(point, which))));
        context.stroke();
      }
    }
    context.lineJoin = "round";
    for (const run of runs(points, (point) => of(point, ""))) {
      context.beginPath();
      run.forEach((point) => context.lineTo(x(point.timeS), y(of(point, ""))));
      context.stroke();
    }
  }

  /** The greatest value of each span, as the colour of its time. */
  colours(points, of, x, top, rowPx, most, shades) {
    const { context } = this;
    points.forEach((point, k) => {
      const value = of(point, "max_");
      if (value === null) return; // not known: nothing is drawn
      const to = x(point.timeS);
      const from = point.gap || !points[k - 1] ? to - 2 : x(points[k - 1].timeS);
      context.fillStyle = shadeOf(shades, value / most).fill;
      context.fillRect(from, top, to - from + 0.5, rowPx - 0.5);
    });
  }
}
