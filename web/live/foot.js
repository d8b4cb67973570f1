// Foot: tiles coloured by load, from the side (line of tiles) or from above with toes up (heat map on a
// grid), with the centre of pressure.

import { FRAME } from "../common/flags.js";
import { FootLayout, isGrid, isPlan } from "../common/foot_layout.js";
import { shadeOf, shadesOf } from "../common/heat.js";
import { place, svg } from "../common/svg.js";
import { byId, number, setData, setText } from "../common/text.js";
import { Cop } from "./cop.js";
import { Range } from "./range.js";
import { FAULT_STATES, readTile } from "./tile.js";

const SIDE_PX = 42; // left and right of a foot from above: legend, direction of the toes
const LOW_PX = 220; // below: little room under the foot
const LIFT_PX = 12; // over the ground in flight
const NUMBERS_FROM_PX = 26; // width of a square that holds a number
const NAMES_FROM_PX = 34; // that holds a name above it
const LETTER_PX = 6.5; // of such a name
const KEY_PX = 18; // height of the legend of reference tiles

/** SVG of the foot. */
export class Foot {
  /** @param {Range} [range] full scale of the colours */
  constructor(range = new Range()) {
    this.root = byId("foot", SVGSVGElement);
    this.range = range;
    this.key = "";
    this.resized = () => {};
    new ResizeObserver(() => this.rebuild()).observe(this.root);
    for (const what of ["(prefers-color-scheme: dark)", "(prefers-contrast: more)"]) {
      matchMedia(what).addEventListener("change", () => this.rebuild());
    }
    document.addEventListener("foottile-colours", () => this.rebuild());
  }

  /** Build again at the next drawing: size or colours have changed. */
  rebuild() {
    this.key = "";
    this.resized();
  }

  /** Build the picture, if the tiles have changed. */
  fit(node) {
    if (this.key && node.tiles === this.tiles) return;
    const key = JSON.stringify([node?.node, node?.tiles, Boolean(node?.servo)]);
    this.tiles = node?.tiles ?? [];
    if (key === this.key) return;
    this.key = key;
    if (node?.node !== this.shown) this.cop = null; // the trail is of another foot
    this.shown = node?.node;
    this.plan = isPlan(this.tiles);
    this.grid = isGrid(this.tiles);
    this.hasReference = this.tiles.some((tile) => tile.reference);
    setData(this.root, "grid", String(this.grid));
    setText(byId("foot-title"), this.plan ? "Top view" : "Side view");
    this.build(Boolean(node?.servo));
  }

  build(turns) {
    const widthPx = this.root.clientWidth || 400;
    const heightPx = this.root.clientHeight || 260;
    this.root.setAttribute("viewBox", `0 0 ${widthPx} ${heightPx}`);
    this.shades = shadesOf(this.root);
    this.layout = new FootLayout(this.tiles, this.plan
      ? { widthPx: widthPx - 2 * SIDE_PX, heightPx, roomPx: this.hasReference ? 2 * KEY_PX : 6, toesUp: true, margin: this.grid ? 0.56 : 0.75 }
      : { widthPx, heightPx, turns, ...(heightPx < LOW_PX ? { roomPx: 76, basePx: 58 } : { roomPx: 108, basePx: 76 }) });
    this.turning = svg("g", this.plan ? { transform: `translate(${SIDE_PX} 0)` } : {});
    this.turning.append(this.plan ? this.outline() : svg("path", { class: "sole", d: this.layout.sole() }));
    this.symbols = this.tiles.map((tile, i) => this.addSymbol(tile, i));
    this.cop = new Cop(this.layout, this.cop?.past);
    this.turning.append(...this.cop.parts, ...this.symbols.flatMap(({ names }) => names)); // nothing covers the text
    this.ground = svg("line", { class: "ground", x1: 0, x2: widthPx });
    const hint = this.plan
      ? [svg("text", { class: "hint", x: widthPx - 4, y: 18, "text-anchor": "end" }, "↑"), svg("text", { class: "hint", x: widthPx - 4, y: 34, "text-anchor": "end" }, "toes")]
      : [svg("text", { class: "hint", x: widthPx - 8, y: heightPx - 6, "text-anchor": "end" }, "forward →"), this.ground];
    this.root.replaceChildren(...hint, this.legend(heightPx), ...(this.hasReference ? [referenceKey(heightPx, this.grid)] : []), this.turning);
  }

  /** Return the outline around the tiles from above. */
  outline() {
    const { points, pitch, scale } = this.layout;
    const around = 0.54 * pitch * scale;
    const [left, top] = [Math.min(...points.map(({ x }) => x)) - around, Math.min(...points.map(({ y }) => y)) - around];
    const [right, bottom] = [Math.max(...points.map(({ x }) => x)) + around, Math.max(...points.map(({ y }) => y)) + around];
    return svg("rect", { class: "sole", x: left, y: top, width: right - left, height: bottom - top, rx: 8 });
  }

  /** Return the colour scale. */
  legend(heightPx) {
    const group = svg("g", { class: "heat-legend" });
    const [x, top, long] = [4, 24, Math.max(40, Math.min(120, heightPx / 3))];
    const step = long / this.shades.length;
    this.shades.forEach(({ fill }, i) => group.append(svg("rect", {
      x, y: (top + long - (i + 1) * step).toFixed(2), width: 10, height: (step + 0.5).toFixed(2), fill,
    })));
    this.top = svg("text", { class: "hint", x, y: 16 });
    group.append(svg("rect", { class: "frame", x, y: top, width: 10, height: long }), this.top, svg("text", { class: "hint", x: x + 15, y: top + long }, "0"));
    return group;
  }

  /** Add the symbol of a tile: dome, force arrow, fault cross; return it with its name. */
  addSymbol(tile, i) {
    const { x, y } = this.layout.points[i];
    const cell = this.layout.pitch * this.layout.scale;
    const r = this.grid ? 0.46 * cell : this.layout.radiusPx;
    const group = svg("g", { class: "tile-symbol" });
    const dome = this.grid
      ? svg("rect", { class: "dome", x: x - r, y: y - r, width: 2 * r, height: 2 * r, rx: 0.12 * cell })
      : svg("circle", { class: "dome", cx: x, cy: y, r });
    const cross = svg("path", { class: "cross", d: `M${x - r} ${y - r}L${x + r} ${y + r}M${x - r} ${y + r}L${x + r} ${y - r}` });
    const arrow = svg("path", { class: "arrow" });
    const isNamed = this.grid && 2 * r >= Math.max(NAMES_FROM_PX, LETTER_PX * tile.serial.length);
    const text = (cls, down, content) => svg("text", { class: cls, x, y: y + down, "text-anchor": "middle" }, content);
    const label = text("name", isNamed ? 10 : 4, this.grid ? "" : tile.serial);
    const names = r < 13 ? [] : isNamed ? [label, text("name above", -5, tile.serial)] : [label];
    group.append(dome, arrow, cross, svg("title", {}, tile.serial));
    this.turning.append(group);
    setData(group, "reference", String(Boolean(tile.reference)));
    return { group, dome, arrow, number: this.grid && cell >= NUMBERS_FROM_PX ? label : null, names };
  }

  /** Extend the trail of the COP by a frame that is not drawn. */
  noteCop(node, frame) {
    if (node?.node === this.shown) this.cop?.notePosition(frame);
  }

  /** Draw a frame and write its numbers. @param {"N" | "kPa"} unit */
  draw(node, frame, unit) {
    this.fit(node);
    this.range.update(node, frame, performance.now());
    const fullScale = this.range.ofFoot(unit);
    setText(this.top, `${number(fullScale, fullScale < 10 && fullScale % 1 ? 1 : 0)} ${unit}`);
    this.turn(node, frame);
    this.writeAngle(node, frame);
    this.symbols.forEach((symbol, i) => this.drawTile(symbol, i, readTile(node, i, frame, unit), fullScale));
    this.cop.draw(node, frame);
  }

  drawTile({ group, dome, arrow, number: label, names }, i, reading, fullScale) {
    const fault = FAULT_STATES.has(reading.state);
    setData(group, "state", fault ? "fault" : reading.state);
    const known = reading.value !== null && !this.tiles[i].reference;
    const share = reading.state === "saturated" ? 1 : known ? Math.max(0, reading.value / fullScale) : 0;
    const { fill, ink } = known ? shadeOf(this.shades, share) : { fill: "none", ink: "" };
    place(dome, { fill });
    for (const name of names) place(name, { fill: known ? ink : "currentColor", stroke: fill });
    if (label) setText(label, known ? number(reading.value, reading.unit === "kPa" && reading.value < 9.95 ? 1 : 0) : reading.bound ? `≥${reading.bound}` : "");
    if (!this.plan) this.drawArrow(arrow, i, Math.min(1, share));
  }

  drawArrow(path, i, part) {
    const { layout } = this;
    const { x, y } = layout.points[i];
    const r = layout.radiusPx;
    const longest = Math.max(30, y - r - 44);
    const length = part * longest;
    if (length < 4) return place(path, { d: "" });
    const n = layout.inward(i);
    const from = { x: x + n.x * r, y: y + n.y * r };
    const to = { x: from.x + n.x * length, y: from.y + n.y * length };
    const head = Math.min(9, length);
    const side = (sign) => `${to.x - n.x * head - sign * n.y * 0.6 * head} ${to.y - n.y * head + sign * n.x * 0.6 * head}`;
    return place(path, { d: `M${from.x} ${from.y}L${to.x} ${to.y}M${side(1)}L${to.x} ${to.y}L${side(-1)}` });
  }

  writeAngle(node, frame) {
    const label = byId("angle");
    label.hidden = !node.servo;
    const angle = frame?.angle_rad ?? null;
    const stale = Boolean((frame?.frame_flags ?? 0) & FRAME.SERVO_STALE);
    const degrees = angle === null ? "unknown" : `${angle > 0 ? "+" : ""}${number((angle * 180) / Math.PI)}°`;
    const turnless = Boolean((frame?.frame_flags ?? 0) & FRAME.SERVO_TURN_UNKNOWN);
    setText(label, `Foot angle ${degrees}${stale ? ", servo stale" : turnless ? ", servo turn unknown" : ""}`);
    setData(label, "stale", String(stale));
    setData(label, "known", String(angle !== null));
  }

  /** Rotate the foot to the servo's angle and put the ground below it. */
  turn(node, frame) {
    if (this.plan) return;
    const angle = frame?.angle_rad ?? null;
    // Clockwise on the screen: the front comes down, so contact moves forward.
    const turn = node.servo && angle !== null ? angle : 0;
    const { layout } = this;
    const { x: cx, y: cy } = layout.at(0, 0); // the ankle
    place(this.turning, { transform: `rotate(${((turn * 180) / Math.PI).toFixed(2)} ${cx.toFixed(2)} ${cy.toFixed(2)})` });
    const lowest = Math.max(...layout.points.map((p) => cy + (p.x - cx) * Math.sin(turn) + (p.y - cy) * Math.cos(turn)));
    const y = lowest + layout.radiusPx + (frame?.contact === false ? LIFT_PX : 0);
    place(this.ground, { y1: y, y2: y });
  }
}

/** Return the legend of reference tiles: their dashed symbol and its meaning. */
function referenceKey(heightPx, isGrid) {
  const y = heightPx - 6;
  const symbol = isGrid ? svg("rect", { x: 5, y: y - 10, width: 11, height: 11, rx: 1 }) : svg("circle", { cx: 10.5, cy: y - 4.5, r: 5.5 });
  const group = svg("g", { class: "reference-key" });
  group.append(symbol, svg("text", { class: "hint", x: 22, y }, "unloaded reference"));
  return group;
}
