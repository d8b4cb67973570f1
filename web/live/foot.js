// The foot from the side (line of tiles) or from above (grid), with forces, COP and its uncertainty.

import { whyNot } from "./grf.js";
import { ESTIMATE, FRAME } from "../common/bits.js";
import { byId, number, plain, setData, setText } from "../common/text.js";
import { FAULT_STATES, readTile } from "./tile.js";

const Z95 = 1.96;
const GRID_FROM_M = 0.005; // tiles spread wider than this in y are a grid
const MM = 1000;
const SVG = "http://www.w3.org/2000/svg";

function svg(tag, attributes = {}, text = null) {
  const element = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  if (text !== null) element.textContent = text;
  return element;
}

function place(element, attributes) {
  for (const [name, value] of Object.entries(attributes)) {
    element.setAttribute(name, typeof value === "number" ? value.toFixed(2) : value);
  }
}

const range = (values) => [Math.min(...values), Math.max(...values)];

export class Foot {
  constructor() {
    this.root = byId("foot");
    this.key = "";
    new ResizeObserver(() => { this.key = ""; this.resized?.(); }).observe(this.root);
  }

  fit(node) {
    const key = JSON.stringify([node?.node, node?.tiles, Boolean(node?.servo)]);
    if (key === this.key) return;
    this.key = key;
    this.tiles = node?.tiles ?? [];
    const [least, most] = range(this.tiles.map((tile) => tile.y_m));
    this.plan = most - least > GRID_FROM_M;
    setText(byId("foot-title"), this.plan ? "Centre of pressure, from above" : "Centre of pressure, from the side");
    this.build(Boolean(node?.servo));
  }

  build(turns) {
    const widthPx = this.root.clientWidth || 400;
    const heightPx = this.root.clientHeight || 260;
    this.root.setAttribute("viewBox", `0 0 ${widthPx} ${heightPx}`);
    const up = (tile) => (this.plan ? tile.y_m : tile.z_m);
    const [left, right] = range(this.tiles.map((tile) => tile.x_m));
    const [low, high] = range(this.tiles.map(up));
    this.pitch = spacing(this.tiles, up);
    const margin = 0.9 * this.pitch;
    // Rolling by 10 degrees about the ankle must stay in the picture.
    const roll = !this.plan && turns ? Math.abs(low) * Math.sin(0.17) : 0;
    const spanX = right - left + 2 * (margin + roll);
    const spanUp = high - low + 2 * margin;
    this.scale = Math.min(widthPx / spanX, (heightPx - (this.plan ? 30 : 110)) / spanUp, this.plan ? 4000 : 5000);
    const midX = (left + right) / 2;
    const baseline = this.plan ? heightPx / 2 : heightPx - 74;
    const reference = this.plan ? (low + high) / 2 : low;
    this.toX = (xM) => widthPx / 2 + (xM - midX) * this.scale;
    this.toY = (upM) => baseline - (upM - reference) * this.scale;
    this.radiusPx = Math.min(0.44 * this.pitch * this.scale, 30);
    this.heightPx = heightPx;
    this.widthPx = widthPx;
    this.points = this.tiles.map((tile) => ({ x: this.toX(tile.x_m), y: this.toY(up(tile)) }));

    this.turning = svg("g");
    this.ground = svg("line", { class: "ground", x1: 0, x2: widthPx });
    const parts = this.plan ? [] : [this.ground];
    this.order = this.tiles.map((_, i) => i).sort((a, b) => this.tiles[a].x_m - this.tiles[b].x_m);
    if (!this.plan) this.turning.append(this.sole());
    this.marks = this.tiles.map((tile, i) => this.mark(tile, i));
    this.copBar = svg("path", { class: "cop-span" });
    this.copEllipse = svg("ellipse", { class: "cop-area" });
    this.copMark = svg("path", { class: "cop-mark" });
    this.copHalo = svg("path", { class: "cop-halo" });
    this.turning.append(this.copHalo, this.copEllipse, this.copBar, this.copMark);
    parts.push(this.turning);
    parts.push(svg("text", { class: "hint", x: widthPx - 8, y: 18, "text-anchor": "end" }, "forward →"));
    this.root.replaceChildren(...parts);
  }

  /** The sole behind the tiles, open to the leg above. */
  sole() {
    const first = this.points[this.order[0]];
    const last = this.points[this.order.at(-1)];
    const edge = 0.6 * this.pitch * this.scale;
    const line = this.order.map((i) => `L${this.points[i].x} ${this.points[i].y}`).join("");
    // Narrows to the leg, which leaves the picture at the top.
    const knee = Math.min(first.y, last.y) - 0.45 * this.heightPx;
    const middle = (first.x + last.x) / 2;
    const leg = 0.3 * (last.x - first.x) + 14;
    const top = -2 * this.heightPx;
    return svg("path", {
      class: "sole",
      d: `M${middle - leg} ${top}V${knee}L${first.x - edge} ${first.y - edge}L${first.x - edge} ${first.y}${line}`
        + `L${last.x + edge} ${last.y}L${last.x + edge} ${last.y - edge}L${middle + leg} ${knee}V${top}`,
    });
  }

  mark(tile, i) {
    const { x, y } = this.points[i];
    const r = this.radiusPx;
    const group = svg("g", { class: "mark" });
    const dome = svg("circle", { class: "dome", cx: x, cy: y, r });
    const cross = svg("path", { class: "cross", d: `M${x - r} ${y - r}L${x + r} ${y + r}M${x - r} ${y + r}L${x + r} ${y - r}` });
    const force = this.plan ? svg("circle", { class: "force", cx: x, cy: y, r: 0 }) : svg("path", { class: "arrow" });
    group.append(dome, force, cross);
    if (r >= 13) group.append(svg("text", { class: "name", x, y: y + 4, "text-anchor": "middle" }, tile.serial));
    group.append(svg("title", {}, tile.serial));
    this.turning.append(group);
    return { group, force };
  }

  /** Unit vector from the ground into the foot at tile i, from its neighbours on the line. */
  inward(i) {
    const k = this.order.indexOf(i);
    const a = this.points[this.order[Math.max(0, k - 1)]];
    const b = this.points[this.order[Math.min(this.order.length - 1, k + 1)]];
    const length = Math.hypot(b.x - a.x, b.y - a.y);
    return length ? { x: (b.y - a.y) / length, y: -(b.x - a.x) / length } : { x: 0, y: -1 };
  }

  draw(node, frame) {
    this.fit(node);
    this.drawAngle(node, frame);
    this.marks.forEach(({ group, force }, i) => {
      const reading = readTile(node, i, frame, "N");
      const fault = FAULT_STATES.has(reading.state);
      setData(group, "state", fault ? "fault" : reading.state);
      const tile = this.tiles[i];
      setData(group, "reference", String(Boolean(tile.reference)));
      const full = tile.full_scale_n ?? 30;
      const part = reading.state === "saturated" ? 1
        : tile.reference || reading.value === null ? 0 : Math.max(0, Math.min(1, reading.value / full));
      if (this.plan) place(force, { r: Math.sqrt(part) * this.radiusPx });
      else this.drawArrow(force, i, part);
    });
    this.drawCop(node, frame);
  }

  drawArrow(path, i, part) {
    const longest = Math.max(30, this.points[i].y - this.radiusPx - 44);
    const length = part * longest;
    if (length < 4) return place(path, { d: "" });
    const { x, y } = this.points[i];
    const n = this.inward(i);
    const from = { x: x + n.x * this.radiusPx, y: y + n.y * this.radiusPx };
    const to = { x: from.x + n.x * length, y: from.y + n.y * length };
    const head = Math.min(9, length);
    const side = (sign) => `${to.x - n.x * head - sign * n.y * 0.6 * head} ${to.y - n.y * head + sign * n.x * 0.6 * head}`;
    place(path, { d: `M${from.x} ${from.y}L${to.x} ${to.y}M${side(1)}L${to.x} ${to.y}L${side(-1)}` });
  }

  /** Height of the tile line at x, so that the marker sits on the arc. */
  lineAt(xPx) {
    const line = this.order.map((i) => this.points[i]);
    if (line.length === 1) return line[0].y;
    let k = line.findIndex((point) => point.x >= xPx);
    k = k < 0 ? line.length - 1 : Math.max(1, k);
    const [a, b] = [line[k - 1], line[k]];
    return b.x === a.x ? a.y : a.y + ((xPx - a.x) / (b.x - a.x)) * (b.y - a.y);
  }

  drawCop(node, frame) {
    const note = byId("cop");
    const x = frame?.cop_x_m ?? null;
    const shown = x !== null;
    for (const part of [this.copMark, this.copHalo, this.copBar, this.copEllipse]) part.setAttribute("visibility", shown ? "visible" : "hidden");
    const sigma = frame?.cop_sigma_x_m ?? null;
    setData(note, "xM", shown ? x.toFixed(6) : "");
    setData(note, "sigmaM", shown && sigma !== null ? sigma.toFixed(6) : "");
    if (!shown) return setText(note, `no COP: ${whyNoCop(node, frame)}`);

    const say = (name, value, s) => `${name} ${number(value * MM)}${s === null ? "" : ` ± ${number(Z95 * s * MM)}`} mm`;
    const px = this.toX(x);
    const halfPx = Z95 * (sigma ?? 0) * this.scale;
    if (this.plan) {
      const y = frame.cop_y_m ?? 0;
      const sigmaY = frame.cop_sigma_y_m ?? null;
      setText(note, `COP ${say("x", x, sigma)}, ${say("y", y, sigmaY)} (95 %)`);
      const py = this.toY(y);
      const area = { cx: px, cy: py, rx: Math.max(3, halfPx), ry: Math.max(3, Z95 * (sigmaY ?? 0) * this.scale) };
      place(this.copEllipse, area);
      // Cross hairs outside the ellipse: a small uncertainty must stay visible too.
      const d = hairs(px, py, area.rx, area.ry);
      place(this.copHalo, { d });
      return place(this.copMark, { d });
    }
    setText(note, `COP ${say("x", x, sigma)} (95 %)`);
    const below = this.radiusPx + 8;
    const py = (at) => this.lineAt(at) + below;
    const [a, b] = [px - halfPx, px + halfPx];
    const line = this.order.map((i) => this.points[i].x).filter((at) => at > a && at < b).map((at) => `L${at} ${py(at) + 25}`).join("");
    place(this.copBar, { d: `M${a} ${py(a) + 18}V${py(a) + 32}M${a} ${py(a) + 25}${line}L${b} ${py(b) + 25}M${b} ${py(b) + 18}V${py(b) + 32}` });
    return place(this.copMark, { d: `M${px} ${py(px) - 4}l8 15h-16z` });
  }

  drawAngle(node, frame) {
    const label = byId("angle");
    label.hidden = !node.servo;
    const angle = frame?.angle_rad ?? null;
    const stale = Boolean((frame?.frame_status ?? 0) & FRAME.SERVO_STALE);
    const degrees = angle === null ? "angle unknown" : `${angle > 0 ? "+" : ""}${number((angle * 180) / Math.PI)}°`;
    setText(label, stale ? `${degrees} servo stale` : degrees);
    setData(label, "stale", String(stale));
    if (this.plan) return;
    // Clockwise on the screen: the tiles in front come down, so contact moves forward.
    const turn = node.servo && angle !== null ? angle : 0;
    const [cx, cy] = [this.toX(0), this.toY(0)];
    this.turning.setAttribute("transform", `rotate(${((turn * 180) / Math.PI).toFixed(3)} ${cx.toFixed(2)} ${cy.toFixed(2)})`);
    const lowest = Math.max(...this.points.map((p) => cy + (p.x - cx) * Math.sin(turn) + (p.y - cy) * Math.cos(turn)));
    place(this.ground, { y1: lowest + this.radiusPx, y2: lowest + this.radiusPx });
  }
}

/** A dot in the middle and four strokes around an ellipse. */
const hairs = (x, y, rx, ry) => `M${x} ${y}h.1M${x - rx - 14} ${y}h10M${x + rx + 4} ${y}h10M${x} ${y - ry - 14}v10M${x} ${y + ry + 4}v10`;

/** Distance of a tile to its nearest neighbour: sets the size of the domes. */
function spacing(tiles, up) {
  let least = Infinity;
  tiles.forEach((a, i) => tiles.slice(0, i).forEach((b) => {
    const distance = Math.hypot(a.x_m - b.x_m, up(a) - up(b));
    if (distance > 1e-6) least = Math.min(least, distance);
  }));
  return Number.isFinite(least) ? least : 0.014;
}

function whyNoCop(node, frame) {
  if (!frame) return "waiting for data";
  const bits = frame.estimate_status ?? 0;
  if (!node.tare || node.tare.undone) return "not tared";
  if (!node.calibration) return "no calibration";
  if (bits & (ESTIMATE.TILE_MISSING | ESTIMATE.SATURATED)) return whyNot(node, frame);
  if (frame.contact === false) return "no contact";
  if (bits & ESTIMATE.COP_MASKED) return "too uncertain";
  return "not determined";
}
