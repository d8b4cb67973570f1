// All plots of a session over one time axis on one canvas; the cursor is on another.

import { coloursOf, crisp, decimalsOf, fit, hatching, ticks, whenColoursChange } from "../common/axes.js";
import { byId, number, printable, setData } from "../common/text.js";
import { KINDS, stretchesOf } from "./flags.js";
import { HEAD_PX, drawMarkers, drawPeaks, drawStances, drawTime } from "./overlay.js";
import { drawTiles } from "./heat.js";
import { panelsOf } from "./panels.js";
import { scalesOf } from "./scales.js";
import { drawBand, drawBound, drawClipped, drawSeries } from "./series.js";

const AXIS_PX = 26;
const FOOT_PX = 6;
const ROOM_PX = 200; // of the window, above and below the plots
const RIGHT_PX = 12;
const FONT = "600 12px system-ui, sans-serif";
export const COLOURS = [
  "page", "text", "soft", "edge", "grid", "series", "other", "interval", "stance", "contact", "warn-line", "bad-line", "cop",
  "heat-0", "heat-1", "heat-2", "heat-3",
];
const CONTACT = 2;

function clipTo(context, box, left, right) {
  context.beginPath();
  context.rect(left, box.top - 3, right - left, box.bottom - box.top + 6);
  context.clip();
}

/** Canvas of the plots. */
export class Plots {
  /** @param {HTMLElement} [box] @param {HTMLCanvasElement} [canvas] */
  constructor(box = byId("plots"), canvas = byId("plots-canvas", HTMLCanvasElement)) {
    this.box = box;
    this.canvas = canvas;
    this.over = byId("cursor-canvas", HTMLCanvasElement);
    this.whole = null;
    this.detail = null;
    this.markers = [];
    this.stances = [];
    this.beside = null; // overlay
    this.name = ""; // of the session, with an overlay
    this.asHeat = null;
    this.heat = null; // range of the colours
    this.clipped = new Set();
    this.peaks = []; // boxes of the peaks' signs and values
    this.flags = []; // positions of the markers' flags
    this.panels = [];
    /** @type {Record<string, string> | null} */
    this.colours = null;
    this.drawn = []; // position and scale of each panel
    whenColoursChange(() => { this.colours = null; this.changed(); });
    this.changed = () => {};
  }

  /** @param {import("./bins.js").Bins} whole */
  show(whole) {
    this.whole = whole;
    this.panels = panelsOf(whole, this.asHeat, this.beside);
    setData(this.box, "panels", this.panels.map((panel) => panel.key).join(" "));
  }

  get width() { return this.box.clientWidth; }
  get ratio() { return devicePixelRatio || 1; }
  get left() { return this.width < 600 ? 40 : 56; }
  get plotWidth() { return Math.max(1, this.width - this.left - RIGHT_PX); }
  get height() {
    return HEAD_PX + AXIS_PX + FOOT_PX + this.panels.reduce((sum, panel) => sum + panel.head + this.scaled(panel), 0);
  }

  /** Return the height of a panel: plots fill the screen, if possible. */
  scaled(panel) {
    const all = this.panels.reduce((sum, one) => sum + one.height, 0);
    const heads = HEAD_PX + AXIS_PX + this.panels.reduce((sum, one) => sum + one.head, 0);
    return Math.round(panel.height * Math.min(1.5, Math.max(0.7, (innerHeight - ROOM_PX - heads) / all)));
  }

  x(view) {
    const scale = this.plotWidth / (view.to - view.from);
    return (timeS) => this.left + (timeS - view.from) * scale;
  }

  timeAt(px, view) {
    const share = Math.min(1, Math.max(0, (px - this.left) / this.plotWidth));
    return view.from + share * (view.to - view.from);
  }

  /** Return the finest bins that cover a view. */
  best(view) {
    return this.detail?.contains(view) ? this.detail : this.whole;
  }

  /** Return bins with the interval to draw: coarse bins until fine ones are loaded. */
  layers(view) {
    const { detail, whole } = this;
    const covers = detail?.covers;
    if (!covers || covers.to <= view.from || covers.from >= view.to) return [[whole, view.from, view.to]];
    return [
      [whole, view.from, Math.min(view.to, covers.from)],
      [detail, Math.max(view.from, covers.from), Math.min(view.to, covers.to)],
      [whole, Math.max(view.from, covers.to), view.to],
    ].filter(([, from, to]) => to > from);
  }

  draw(view, current = -1) {
    if (!this.whole || this.width < 50) return;
    this.colours ??= coloursOf(this.box, COLOURS);
    this.box.style.height = `${this.height}px`;
    const context = fit(this.canvas, this.width, this.height, this.ratio);
    context.font = FONT;
    context.fillStyle = this.colours.page;
    context.fillRect(0, 0, this.width, this.height);
    this.patterns = new Map();
    const x = this.x(view);
    const bottom = this.height - AXIS_PX;
    const right = this.left + this.plotWidth;
    drawStances(this, context, view, x, bottom, current);
    const scales = scalesOf(this, view);
    this.clipped = new Set(); // panels with a band that is clipped
    let top = HEAD_PX;
    this.drawn = this.panels.map((panel) => {
      const box = { left: this.left, right, top: top + panel.head, bottom: top + panel.head + this.scaled(panel) };
      top = box.bottom;
      return { panel, box, y: this.drawPanel(context, panel, box, view, x, scales.get(panel.group ?? panel.key)) };
    });
    this.drawFlags(context, view, x);
    const force = this.drawn.find(({ panel }) => panel.key === "grf");
    this.peaks = force ? drawPeaks(this, context, view, x, force.box, force.y) : [];
    drawTime(this, context, view, x, bottom);
    drawMarkers(this, context, view, x, bottom);
    setData(this.box, "framesInBin", String(this.best(view).framesInBin));
    setData(this.box, "clipped", [...this.clipped].join(" "));
    setData(this.box, "kinds", this.shownKinds.map(({ key }) => key).join(" "));
  }

  drawPanel(context, panel, box, view, x, scale) {
    const { colours } = this;
    context.textBaseline = "middle";
    let y = null;
    if (panel.kind === "heat") drawTiles(this, context, panel, box, view, x);
    else {
      const factor = panel.factor ?? 1;
      const shown = (value) => box.bottom - ((value - scale.low) / (scale.high - scale.low)) * (box.bottom - box.top);
      y = (value) => shown(value * factor);
      this.drawScale(context, box, scale, shown);
      const isCop = panel.key.startsWith("cop");
      const layers = panel.besideOnly ? [] : this.layers(view);
      this.drawLayers(context, box, layers, x, (bins, begin, end) => {
        if (panel.key === "grf") this.drawContact(context, bins, begin, end, x, box);
        if (isCop) context.globalAlpha = 0.3;
        if (panel.band) drawBand(context, bins, begin, end, x, y, panel.band, isCop ? colours.cop : colours.interval);
      });
      this.drawBeside(context, panel, box, view, x, y);
      this.drawLayers(context, box, layers, x, (bins, begin, end) => {
        drawSeries(context, bins, begin, end, x, y, panel.columns, isCop ? colours.cop : colours.series);
        if (panel.bound) drawBound(context, bins, begin, end, x, y, panel.bound, colours["warn-line"]);
        if (panel.band && drawClipped(context, bins, begin, end, x, y, panel.band, box, isCop ? colours.cop : colours.series)) this.clipped.add(panel.key);
      });
    }
    this.drawTitle(context, panel, box);
    return y;
  }

  /** Draw each layer within its part of the time axis. */
  drawLayers(context, box, layers, x, draw) {
    for (const [bins, from, to] of layers) {
      const [begin, end] = bins.within({ from, to });
      context.save();
      clipTo(context, box, x(from), x(to));
      // One bin more on both sides: lines run to the edges.
      draw(bins, Math.max(0, begin - 1), Math.min(bins.count, end + 1));
      context.restore();
    }
  }

  /** Draw the overlay below this session's series, wider, so that both show where they agree. */
  drawBeside(context, panel, box, view, x, y) {
    if (!this.beside?.columns[panel.key]) return;
    context.save();
    clipTo(context, box, box.left, box.right);
    const [colour, widthPx] = panel.besideOnly ? [this.colours.text, 1.5] : [this.colours.other, 3.5];
    this.beside.draw(context, panel.key, view, x, y, colour, widthPx);
    context.restore();
  }

  drawTitle(context, panel, box) {
    const { colours } = this;
    const inside = panel.tile !== undefined;
    const text = printable(`${panel.title}, ${panel.unit}${panel.note ? ` (${panel.note})` : ""}`);
    context.textAlign = "left";
    context.textBaseline = "top";
    const [left, top] = inside ? [box.left + 6, box.top + 2] : [box.left, box.top - 15];
    context.lineJoin = "round";
    context.lineWidth = 4;
    context.strokeStyle = colours.page;
    context.strokeText(text, left, top);
    context.fillStyle = colours.text;
    context.fillText(text, left, top);
  }

  drawScale(context, box, scale, y) {
    const { colours } = this;
    context.lineWidth = 1;
    const height = box.bottom - box.top;
    const most = Math.max(height < 45 ? 2 : 3, Math.floor(height / 28));
    const { step, values } = ticks(scale.low, scale.high, most);
    context.textAlign = "right";
    for (const value of values) {
      const row = crisp(y(value));
      context.strokeStyle = Math.abs(value) < step * 1e-6 ? colours.edge : colours.grid;
      context.beginPath();
      context.moveTo(box.left, row);
      context.lineTo(box.right, row);
      context.stroke();
      context.fillStyle = colours.text;
      // Not beyond the panel: the next tile's scale begins 7 px below it.
      const textRow = Math.min(Math.max(row, box.top + 3), box.bottom - 3);
      if (!scale.empty) context.fillText(number(value, decimalsOf(step)), box.left - 6, textRow);
    }
    context.strokeStyle = colours.edge;
    context.beginPath();
    context.moveTo(crisp(box.left), box.top);
    context.lineTo(crisp(box.left), box.bottom);
    context.stroke();
  }

  /** Draw contact as a strip below the GRF. */
  drawContact(context, bins, begin, end, x, box) {
    context.fillStyle = this.colours.contact;
    for (let i = begin; i < end; i++) {
      if (!(bins.columns.contact[i] & CONTACT)) continue;
      const left = Math.floor(x(bins.first[i]));
      context.fillRect(left, box.bottom + 1, Math.max(1, Math.ceil(x(bins.edge(i))) - left), 4);
    }
  }

  pattern(context, colour, way) {
    const key = `${colour} ${way}`;
    if (!this.patterns.has(key)) this.patterns.set(key, hatching(context, this.colours[colour], way));
    return this.patterns.get(key);
  }

  drawFlags(context, view, x) {
    const all = { top: HEAD_PX, bottom: this.height - AXIS_PX };
    const forces = this.drawn.filter(({ panel }) => panel.force).map(({ box }) => box);
    this.shownKinds = [];
    const right = this.left + this.plotWidth;
    for (const kind of KINDS) {
      let some = false;
      for (const [bins, from, to] of this.layers(view)) {
        for (const [begin, end] of stretchesOf(kind, bins, ...bins.within({ from, to }))) {
          if (end < from || begin > to) continue;
          some = true;
          const left = Math.max(this.left, x(Math.max(begin, from)));
          const width = Math.max(2, Math.min(right, x(Math.min(end, to))) - left);
          context.fillStyle = kind.way === "line" ? this.colours[kind.colour] : this.pattern(context, kind.colour, kind.way);
          if (kind.over === "all") {
            context.fillRect(left, all.top, width, all.bottom - all.top);
            context.fillStyle = this.colours[kind.colour];
            context.globalAlpha = 0.25;
            context.fillRect(left, all.top, width, all.bottom - all.top);
            context.globalAlpha = 1;
          } else if (kind.over === "force") {
            context.globalAlpha = 0.55;
            for (const box of forces) context.fillRect(left, box.top, width, box.bottom - box.top);
            context.globalAlpha = 1;
          } else if (forces.length) {
            context.fillRect(left, kind.key === "late" ? forces[0].bottom - 8 : forces[0].bottom + 6, width, kind.key === "late" ? 8 : 3);
          }
        }
      }
      if (some) this.shownKinds.push(kind);
    }
  }

  /** Draw the cursor and the range that is being selected. */
  drawCursor(view, timeS, chosen = null) {
    if (!this.whole) return;
    this.colours ??= coloursOf(this.box, COLOURS);
    const context = fit(this.over, this.width, this.height);
    const x = this.x(view);
    const bottom = this.height - AXIS_PX;
    if (chosen) {
      const [from, to] = chosen.map((at) => x(at));
      context.fillStyle = this.colours.series;
      context.globalAlpha = 0.22;
      context.fillRect(Math.min(from, to), HEAD_PX - 6, Math.abs(to - from), bottom - HEAD_PX + 6);
      context.globalAlpha = 1;
    }
    if (timeS === null || timeS < view.from || timeS > view.to) return;
    const bins = this.best(view);
    const i = bins.at(timeS);
    context.strokeStyle = this.colours.text;
    context.lineWidth = 1.5;
    context.beginPath();
    context.moveTo(x(timeS), HEAD_PX - 6);
    context.lineTo(x(timeS), bottom + 5);
    context.stroke();
    // The line has a gap at a peak and its value: it would hide them.
    const lineX = x(timeS);
    for (const peak of this.peaks) {
      if (peak.left <= lineX && lineX <= peak.right) context.clearRect(lineX - 2, peak.top, 4, peak.bottom - peak.top);
    }
    if (i < 0 || !bins.isAt(i, timeS)) return; // in a gap nothing is known
    for (const { panel, y } of this.drawn) {
      const value = y && bins.columns[panel.columns[1]]?.[i];
      if (value === null || value === undefined) continue;
      context.fillStyle = this.colours.text;
      context.strokeStyle = this.colours.page;
      context.beginPath();
      context.arc(x(timeS), y(value), 4, 0, 7);
      context.fill();
      context.stroke();
    }
  }
}
