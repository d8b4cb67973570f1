// Each tile over time: rows of traces, or of colours for many tiles.

import { coloursOf, fit, whenColoursChange } from "../common/axes.js";
import { shadeOf, shadesOf } from "../common/heat.js";
import { byId, number, printable } from "../common/text.js";
import { fillBand, runs } from "./points.js";
import { Strip } from "./strip.js";
import { unitOf } from "./tile.js";

const KEY = "foottile.tiles-as";
const EVERY_MS = 60; // many rows cost much
const ROW_PX = 16; // lower rows are drawn as colours
const [LEFT_PX, RIGHT_PX] = [50, 10]; // as the GRF trace

/** Traces of all tiles on one canvas. */
export class TileTraces {
  /** @param {import("./range.js").Range} range @param {() => void} onChange */
  constructor(range, onChange) {
    this.range = range;
    this.canvas = byId("tile-traces", HTMLCanvasElement);
    this.context = this.canvas.getContext("2d");
    this.strip = new Strip();
    this.colours = null;
    this.shades = [];
    whenColoursChange(() => { this.colours = null; });
    this.history = null; // history in the strip
    this.restarts = 0;
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

  /** Return the API column of the traces; null: not shown. */
  column(unit) {
    if (!this.shown) return null;
    return unit === "N" ? "force_n" : "gauge_kpa";
  }

  show() {
    byId("as-bars").setAttribute("aria-pressed", String(!this.shown));
    byId("as-traces").setAttribute("aria-pressed", String(this.shown));
    byId("bars-box").hidden = byId("bars-legend").hidden = this.shown;
    this.canvas.hidden = !this.shown;
  }

  /**
   * @param {{tiles: TileView[]}} node
   * @param {{points: TilePoint[], tileHistory: TilePoint[], endS: number, windowS: number, live: boolean}} shown points of the GRF trace
   * @param {number} nowMs
   * @param {string} unitChosen
   */
  draw(node, { points, tileHistory, endS, windowS, live }, nowMs, unitChosen) {
    if (!this.shown || nowMs - this.drawnMs < EVERY_MS) return;
    this.drawnMs = nowMs;
    const { canvas } = this;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (!width || !height) return;
    const context = fit(canvas, width, height);
    if (!this.colours) this.readColours();
    const colours = live ? this.colours : { ...this.colours, fill: this.colours.stale, band: this.colours.stale };
    const recent = points.filter((point) => point.tiles);
    const known = [...tileHistory.filter((point) => point.timeS > endS - windowS), ...recent];
    this.range.update(node, greatestOf(known), nowMs);
    const box = { width: width - RIGHT_PX - LEFT_PX, height, rowPx: height / node.tiles.length };
    const rows = node.tiles.map((tile, i) => {
      const unit = unitOf(tile, unitChosen);
      const of = (point, which) => point.tiles[unit === "N" ? `force_${which}n` : `gauge_${which}kpa`]?.[i] ?? null;
      return { tile, unit, top: i * box.rowPx, most: this.range.of(tile, unit), of };
    });
    context.font = `600 ${Math.min(13, Math.max(8, box.rowPx - 2))}px system-ui, sans-serif`;
    context.fillStyle = colours.text;
    context.textAlign = "right";
    context.textBaseline = "middle";
    rows.forEach(({ tile, top }, i) => { if (box.rowPx >= 9 || i % 4 === 0) context.fillText(printable(tile.serial), LEFT_PX - 5, top + box.rowPx / 2); });
    if (box.rowPx < ROW_PX) this.drawColours(rows, known, tileHistory, { endS, windowS, ...box });
    else this.drawTraces(rows, known, { endS, windowS, ...box }, colours);
  }

  readColours() {
    this.colours = coloursOf(this.canvas, ["text", "grid", "fill", "band", "stale", "edge"]);
    this.shades = shadesOf(this.canvas);
  }

  drawTraces(rows, points, { endS, windowS, width, rowPx }, colours) {
    const { context } = this;
    const x = (timeS) => LEFT_PX + width - ((endS - timeS) / windowS) * width;
    for (const { unit, top, most, of } of rows) {
      context.save();
      context.beginPath();
      context.rect(LEFT_PX, top, width, rowPx);
      context.clip();
      this.trace(points, of, x, top, rowPx, most, colours);
      context.restore();
      context.fillStyle = colours.text;
      context.textAlign = "left";
      context.textBaseline = "top";
      if (rowPx >= 26) context.fillText(`${number(most, most < 10 && most % 1 ? 1 : 0)} ${unit}`, LEFT_PX + 3, top + 3);
    }
  }

  trace(points, of, x, top, rowPx, most, colours) {
    const { context } = this;
    const y = (value) => top + rowPx - 2 - (Math.max(-0.1, value / most) + 0.1) / 1.1 * (rowPx - 4);
    context.fillStyle = colours.grid;
    context.fillRect(LEFT_PX, top + rowPx - 1, 1e4, 1);
    context.fillRect(LEFT_PX, Math.round(y(0)), 1e4, 1);
    context.fillStyle = colours.band;
    for (const run of runs(points, (point) => of(point, "max_"))) fillBand(context, run, x, y, (point) => of(point, "min_"), (point) => of(point, "max_"));
    context.strokeStyle = colours.fill;
    context.lineWidth = 1.5;
    // History has min and max, not the latest value.
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

  /** Draw the max of each span as a colour. */
  drawColours(rows, points, tileHistory, { endS, windowS, width, height, rowPx }) {
    const { strip, shades } = this;
    if (tileHistory !== this.history) [this.history, this.restarts] = [tileHistory, this.restarts + 1];
    const key = [this.restarts, shades.map(({ fill }) => fill), ...rows.map(({ tile, unit, most }) => `${tile.serial} ${most} ${unit}`)].join();
    strip.draw(points, { endS, windowS, widthPx: width, heightPx: height, key }, (context, k, x) => {
      const to = x(points[k].timeS);
      const from = Math.min(to - 2, x(points[k].fromS));
      for (const { of, top, most } of rows) {
        const value = of(points[k], "max_");
        if (value === null) continue; // unknown
        context.fillStyle = shadeOf(shades, value / most).fill;
        context.fillRect(from, top, to - from + 0.5, rowPx - 0.5);
      }
    });
    strip.show(this.context, LEFT_PX, 0, width, height);
  }
}

/** @typedef {{fromS: number, timeS: number, tiles: Record<string, (number | null)[]> | null, gap?: boolean}} TilePoint */

/** Return the greatest values of the visible points, in the form of a frame. @param {TilePoint[]} points */
function greatestOf(points) {
  const most = { force_max_n: [0], gauge_max_kpa: [0] };
  for (const { tiles } of points) {
    for (const [name, found] of Object.entries(most)) for (const value of tiles[name] ?? []) if (value > found[0]) found[0] = value;
  }
  return most;
}
