// Small foot on a canvas: tiles shaded by force, and the centre of pressure.

import { FootLayout, isPlan } from "../common/foot_layout.js";
import { shadeOf, shadesOf } from "../common/heat.js";
import { number } from "../common/text.js";
import { Range } from "../live/range.js";
import { FAULT_STATES, readTile } from "../live/tile.js";

const Z95 = 1.96;
const LEGEND_PX = 40; // left of a foot from above
const NARROW_PX = 240; // card on a phone: half the legend's margin
const NUMBERS_FROM_PX = 10; // radius of a tile that holds a number

/** Foot of a card. */
export class SmallFoot {
  /** @param {HTMLCanvasElement} canvas */
  constructor(canvas) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    this.key = "";
    this.colours = null;
    this.layout = null;
    this.range = new Range(); // fixed: rated load
    new ResizeObserver(() => { this.key = ""; }).observe(canvas);
  }

  /** Read the colours again. */
  recolour() {
    this.colours = null;
  }

  fit(node) {
    const { canvas } = this;
    if (!node.tiles.length) return;
    const ratio = devicePixelRatio || 1;
    const key = JSON.stringify([node.tiles, Boolean(node.servo), canvas.clientWidth, canvas.clientHeight, ratio]);
    if (key === this.key) return;
    this.key = key;
    this.widthPx = canvas.clientWidth;
    this.heightPx = canvas.clientHeight;
    canvas.width = Math.round(this.widthPx * ratio);
    canvas.height = Math.round(this.heightPx * ratio);
    this.ratio = ratio;
    const { widthPx, heightPx } = this;
    const room = isPlan(node.tiles) ? { roomPx: 8 } : { roomPx: 0.4 * heightPx, basePx: 0.4 * heightPx }; // room for the COP
    this.leftPx = isPlan(node.tiles) ? LEGEND_PX : widthPx < NARROW_PX ? LEGEND_PX / 2 : 0;
    const box = { widthPx: widthPx - 2 * this.leftPx, heightPx, ...room, turns: Boolean(node.servo), toesUp: true };
    this.layout = new FootLayout(node.tiles, box);
    this.sole = !this.layout.plan ? new Path2D(this.layout.sole()) : null;
  }

  readColours() {
    const style = getComputedStyle(this.canvas);
    const colour = (name) => style.getPropertyValue(name).trim();
    this.colours = {
      text: colour("--text"), track: colour("--track"), edge: colour("--edge"), warn: colour("--warn-line"),
      bad: colour("--bad-line"), badFill: colour("--bad"), cop: colour("--cop"), panel: colour("--panel"),
      shades: shadesOf(this.canvas),
    };
  }

  draw(node, frame) {
    this.fit(node);
    const { context, layout } = this;
    if (!this.widthPx || !layout) return;
    if (!this.colours) this.readColours();
    context.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    context.clearRect(0, 0, this.widthPx, this.heightPx);
    this.range.update(node, frame, performance.now());
    this.drawLegend();
    context.save();
    context.translate(this.leftPx, 0);
    if (!layout.plan && node.servo && Number.isFinite(frame?.angle_rad)) {
      const ankle = layout.at(0, 0);
      context.translate(ankle.x, ankle.y);
      context.rotate(frame.angle_rad); // clockwise: the front comes down
      context.translate(-ankle.x, -ankle.y);
    }
    if (this.sole) this.stroke(this.sole, this.colours.edge, 1.5, this.colours.track);
    node.tiles.forEach((tile, i) => this.drawTile(node, tile, i, frame));
    this.drawCop(frame);
    context.restore();
  }

  /** Draw the colour scale, up to the rated load. */
  drawLegend() {
    const { context, colours } = this;
    const [top, long] = [18, Math.min(70, 0.5 * this.heightPx)];
    const step = long / colours.shades.length;
    colours.shades.forEach(({ fill }, i) => {
      context.fillStyle = fill;
      context.fillRect(1, top + long - (i + 1) * step, 9, step + 0.5);
    });
    context.strokeStyle = colours.edge;
    context.lineWidth = 1;
    context.strokeRect(0.5, top + 0.5, 10, long);
    context.fillStyle = colours.text;
    context.font = "600 12px system-ui, sans-serif";
    context.textAlign = "left";
    context.textBaseline = "alphabetic";
    context.fillText(`${number(this.range.ofFoot("N"), 0)} N`, 0, 12);
    context.fillText("0", 14, top + long);
  }

  drawTile(node, tile, i, frame) {
    const { context, colours } = this;
    const { x, y } = this.layout.points[i];
    const r = Math.max(3, this.layout.radiusPx);
    const { state, value } = readTile(node, i, frame, "N");
    const fault = FAULT_STATES.has(state);
    const isKnown = value !== null && !tile.reference;
    const share = state === "saturated" ? 1 : isKnown ? value / this.range.ofFoot("N") : 0;
    const shade = shadeOf(colours.shades, share);
    context.fillStyle = fault ? colours.badFill : shade.fill;
    context.strokeStyle = fault ? colours.bad : state === "saturated" ? colours.warn : colours.text;
    context.lineWidth = state === "saturated" ? 3 : r < 8 ? 0.75 : 1.5; // thin on small tiles
    context.setLineDash(tile.reference || !["ok", "saturated"].includes(state) ? [3, 3] : []);
    context.beginPath();
    context.arc(x, y, r, 0, 2 * Math.PI);
    context.fill();
    context.stroke();
    context.setLineDash([]);
    if (isKnown && r >= NUMBERS_FROM_PX) {
      context.fillStyle = shade.ink;
      context.font = `800 ${r < 14 ? 11 : 13}px system-ui, sans-serif`;
      context.textAlign = "center";
      context.textBaseline = "middle";
      context.fillText(number(Math.max(0, value), 0), x, y + 0.5);
    }
    if (!fault) return;
    context.beginPath();
    for (const side of [-1, 1]) {
      context.moveTo(x - r, y - side * r);
      context.lineTo(x + r, y + side * r);
    }
    context.stroke();
  }

  /** Draw the COP: from the side an arrow with its 95 % bar, from above a dot in its ellipse. */
  drawCop(frame) {
    const { context, colours, layout } = this;
    const place = layout.copPlace(frame?.cop_x_m, frame?.cop_y_m);
    if (!place) return;
    context.strokeStyle = colours.cop;
    context.fillStyle = colours.cop;
    context.lineWidth = 2;
    const half = (sigma_m) => Z95 * (Number.isFinite(sigma_m) ? sigma_m : 0) * layout.scale;
    context.beginPath();
    if (layout.plan) {
      const { x, y } = layout.at(place.x, place.y);
      const [across, along] = [frame.cop_sigma_y_m, frame.cop_sigma_x_m].map((sigma_m) => Math.max(4, half(sigma_m)));
      context.ellipse(x, y, across, along, 0, 0, 2 * Math.PI); // toes up
      context.stroke();
      context.beginPath();
      context.arc(x, y, 3, 0, 2 * Math.PI);
      context.fill();
      return;
    }
    const { x } = layout.at(place.x, 0);
    const y = layout.lineAt(x) + layout.radiusPx + 4;
    context.moveTo(x, y);
    const long = Math.min(11, 0.09 * this.heightPx);
    context.lineTo(x - 0.55 * long, y + long);
    context.lineTo(x + 0.55 * long, y + long);
    context.fill();
    const [a, b] = [x - half(frame.cop_sigma_x_m), x + half(frame.cop_sigma_x_m)];
    context.beginPath();
    context.moveTo(a, y + long + 3);
    context.lineTo(b, y + long + 3);
    context.stroke();
  }

  stroke(path, colour, width, fill) {
    const { context } = this;
    context.fillStyle = fill;
    context.fill(path);
    context.strokeStyle = colour;
    context.lineWidth = width;
    context.stroke(path);
  }
}
