// The foot from the side (line of tiles) or from above (grid), with forces, COP and its uncertainty.

import { whyNot } from "./grf.js";
import { ESTIMATE, FRAME } from "../common/bits.js";
import { FootLayout, isPlan } from "../common/foot_layout.js";
import { byId, number, setData, setText } from "../common/text.js";
import { FAULT_STATES, readTile } from "./tile.js";

const Z95 = 1.96;
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
    this.plan = isPlan(this.tiles);
    setText(byId("foot-title"), this.plan ? "Centre of pressure, from above" : "Centre of pressure, from the side");
    this.build(Boolean(node?.servo));
  }

  build(turns) {
    const widthPx = this.root.clientWidth || 400;
    const heightPx = this.root.clientHeight || 260;
    this.root.setAttribute("viewBox", `0 0 ${widthPx} ${heightPx}`);
    this.layout = new FootLayout(this.tiles, { widthPx, heightPx, turns, roomPx: this.plan ? 30 : 110 });

    this.turning = svg("g");
    this.ground = svg("line", { class: "ground", x1: 0, x2: widthPx });
    const parts = this.plan ? [] : [this.ground];
    if (!this.plan) this.turning.append(svg("path", { class: "sole", d: this.layout.sole() }));
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

  mark(tile, i) {
    const { x, y } = this.layout.points[i];
    const r = this.layout.radiusPx;
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
      if (this.plan) place(force, { r: Math.sqrt(part) * this.layout.radiusPx });
      else this.drawArrow(force, i, part);
    });
    this.drawCop(node, frame);
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
    place(path, { d: `M${from.x} ${from.y}L${to.x} ${to.y}M${side(1)}L${to.x} ${to.y}L${side(-1)}` });
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
    const { layout } = this;
    const halfPx = Z95 * (sigma ?? 0) * layout.scale;
    if (this.plan) {
      const y = frame.cop_y_m ?? 0;
      const sigmaY = frame.cop_sigma_y_m ?? null;
      setText(note, `COP ${say("x", x, sigma)}, ${say("y", y, sigmaY)} (95 %)`);
      const { x: px, y: py } = layout.at(x, y);
      const area = { cx: px, cy: py, rx: Math.max(3, halfPx), ry: Math.max(3, Z95 * (sigmaY ?? 0) * layout.scale) };
      place(this.copEllipse, area);
      // Cross hairs outside the ellipse: a small uncertainty must stay visible too.
      const d = hairs(px, py, area.rx, area.ry);
      place(this.copHalo, { d });
      return place(this.copMark, { d });
    }
    setText(note, `COP ${say("x", x, sigma)} (95 %)`);
    const px = layout.at(x, 0).x;
    const below = layout.radiusPx + 8;
    const py = (at) => layout.lineAt(at) + below;
    const [a, b] = [px - halfPx, px + halfPx];
    const line = layout.order.map((i) => layout.points[i].x).filter((at) => at > a && at < b).map((at) => `L${at} ${py(at) + 25}`).join("");
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
    const { layout } = this;
    const { x: cx, y: cy } = layout.at(0, 0); // the ankle
    this.turning.setAttribute("transform", `rotate(${((turn * 180) / Math.PI).toFixed(3)} ${cx.toFixed(2)} ${cy.toFixed(2)})`);
    const lowest = Math.max(...layout.points.map((p) => cy + (p.x - cx) * Math.sin(turn) + (p.y - cy) * Math.cos(turn)));
    place(this.ground, { y1: lowest + layout.radiusPx, y2: lowest + layout.radiusPx });
  }
}

/** A dot in the middle and four strokes around an ellipse. */
const hairs = (x, y, rx, ry) => `M${x} ${y}h.1M${x - rx - 14} ${y}h10M${x + rx + 4} ${y}h10M${x} ${y - ry - 14}v10M${x} ${y + ry + 4}v10`;

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
