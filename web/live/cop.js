// Centre of pressure on the foot: position, 95 % region and trail.

import { ESTIMATE } from "../common/flags.js";
import { place, svg } from "../common/svg.js";
import { byId, number, setData, setText } from "../common/text.js";
import { whyNot } from "./grf.js";

const Z95 = 1.96;
const MM = 1000;
const TRAIL_S = 2;
const PARTS = 8; // of the trail, older ones paler
const GAP_S = 0.25; // longer gaps interrupt the trail

/** COP symbol, uncertainty and trail. */
export class Cop {
  /**
   * @param {import("../common/foot_layout.js").FootLayout} layout
   * @param {{timeS: number, x: number | null, y: number | null}[]} past of the last seconds, oldest first, kept over a change of size
   */
  constructor(layout, past = []) {
    this.layout = layout;
    this.past = past;
    this.span = svg("path", { class: "cop-span" });
    this.area = svg("ellipse", { class: "cop-area" });
    this.symbol = svg("path", { class: "cop-symbol" });
    this.halo = svg("path", { class: "cop-halo" });
    this.trail = Array.from({ length: PARTS }, (_, i) => svg("path", { class: "cop-trail", opacity: ((i + 1) / PARTS).toFixed(2) }));
    if (!layout.plan) this.trail.forEach((part) => part.classList.add("on-sole"));
    this.parts = [...this.trail, this.halo, this.area, this.span, this.symbol];
  }

  draw(node, frame) {
    const note = byId("cop");
    const at = this.layout.copPlace(frame?.cop_x_m, frame?.cop_y_m);
    const shown = at !== null;
    this.notePosition(frame);
    this.drawTrail(frame);
    for (const part of [this.symbol, this.halo, this.span, this.area]) place(part, { visibility: shown ? "visible" : "hidden" });
    const sigma = frame?.cop_sigma_x_m ?? null;
    setData(note, "xM", shown ? at.x.toFixed(6) : "");
    setData(note, "sigmaM", shown && sigma !== null ? sigma.toFixed(6) : "");
    setText(note, shown ? this.text(frame) : `No COP: ${whyNoCop(node, frame, this.layout)}${frame?.contact === false ? this.lastText() : ""}`);
    if (!shown) return;
    if (this.layout.plan) this.drawPlan(frame, at);
    else this.drawSide(frame, at);
  }

  /** Return the position as text. */
  text({ cop_x_m: x = null, cop_y_m: y = null, cop_sigma_x_m: sigmaX = null, cop_sigma_y_m: sigmaY = null }) {
    const all = [["x", x, sigmaX], ...(this.layout.plan ? [["y", y, sigmaY]] : [])];
    const measured = all.filter(([, value]) => value !== null).map(([name, value, sigma]) => coordinateText(name, value, sigma));
    const others = all.filter(([, value]) => value === null).map(([name]) => `, ${name} not measured`);
    return `COP ${measured.join(", ")} (95\u00a0%)${others.join("")}`;
  }

  /** Return the last position before flight as text. */
  lastText() {
    const last = this.past.findLast((one) => one.x !== null);
    if (!last) return "";
    const { plan, row } = this.layout;
    const measured = ["x", ...(plan ? ["y"] : [])].filter((name) => row[name] === null);
    return `, last ${measured.map((name) => `${name} ${number(last[name] * MM)}`).join(", ")} mm`;
  }

  drawPlan(frame, { x, y }) {
    const { cop_sigma_x_m: sigmaX = null, cop_sigma_y_m: sigmaY = null } = frame;
    const at = this.layout.at(x, y);
    const halfPx = (sigma) => Math.max(3, Z95 * (sigma ?? 0) * this.layout.scale);
    const [across, along] = this.layout.toesUp ? [sigmaY, sigmaX] : [sigmaX, sigmaY];
    const area = { cx: at.x, cy: at.y, rx: halfPx(across), ry: halfPx(along) };
    place(this.area, area);
    // Cross hairs outside the ellipse keep a small one visible.
    const d = hairs(at.x, at.y, area.rx, area.ry);
    place(this.halo, { d });
    place(this.symbol, { d });
  }

  drawSide(frame, { x }) {
    const { layout } = this;
    const { cop_sigma_x_m: sigma = null } = frame;
    const px = layout.at(x, 0).x;
    const halfPx = Z95 * (sigma ?? 0) * layout.scale;
    const [a, b] = [px - halfPx, px + halfPx];
    const y = (at) => this.below(at);
    const line = layout.order.map((i) => layout.points[i].x).filter((at) => at > a && at < b).map((at) => `L${at} ${y(at) + 19}`).join("");
    place(this.span, { d: `M${a} ${y(a) + 12}V${y(a) + 26}M${a} ${y(a) + 19}${line}L${b} ${y(b) + 19}M${b} ${y(b) + 12}V${y(b) + 26}` });
    place(this.symbol, { d: `M${px} ${y(px) - 6}l8 15h-16z` });
  }

  /** Return the height of the symbol, below the line of tiles. */
  below(xPx) {
    return this.layout.lineAt(xPx) + this.layout.radiusPx + 10;
  }

  /** Extend the trail, by the time stamps of the frames: replay has one, too. */
  notePosition(frame) {
    const { past, layout } = this;
    const nowS = timeOf(frame);
    if (nowS === null) past.length = 0;
    else if (past.at(-1)?.timeS !== nowS) {
      if (past.length && nowS < past.at(-1).timeS) past.length = 0;
      past.push({ timeS: nowS, x: null, y: null, ...layout.copPlace(frame.cop_x_m, frame.cop_y_m) });
      while (past[0].timeS < nowS - TRAIL_S) past.shift();
    }
  }

  drawTrail(frame) {
    const { past, layout } = this;
    const nowS = timeOf(frame);
    setData(layout.plan ? this.area : this.span, "trail", String(past.length));
    const paths = Array.from({ length: PARTS }, () => []);
    past.forEach((one, i) => {
      const before = past[i - 1];
      if (one.x === null || !before || before.x === null || one.timeS - before.timeS > GAP_S) return;
      const age = (nowS - one.timeS) / TRAIL_S;
      paths[Math.min(PARTS - 1, Math.floor((1 - age) * PARTS))].push(`M${this.placeOf(before)}L${this.placeOf(one)}`);
    });
    this.trail.forEach((part, i) => place(part, { d: paths[i].join("") }));
  }

  /** Return a point of the trail: in plan view its position, from the side along the sole. */
  placeOf(one) {
    const at = this.layout.at(one.x, one.y);
    const y = this.layout.plan ? at.y : this.layout.lineAt(at.x) + this.layout.radiusPx;
    return `${at.x.toFixed(1)} ${y.toFixed(1)}`;
  }
}

const timeOf = (frame) => (!frame ? null : Number.isFinite(frame.t_ns) ? frame.t_ns / 1e9 : frame.timeS ?? null);

const coordinateText = (name, value, sigma) => `${name} ${number(value * MM)}${sigma === null ? "" : ` ± ${number(Z95 * sigma * MM)}`} mm`;

/** Return a dot and four strokes around an ellipse. */
const hairs = (x, y, rx, ry) => `M${x} ${y}h.1M${x - rx - 14} ${y}h10M${x + rx + 4} ${y}h10M${x} ${y - ry - 14}v10M${x} ${y + ry + 4}v10`;

/** Return the reason for no COP. */
function whyNoCop(node, frame, { row }) {
  if (!frame) return "no data";
  const bits = frame.estimate_flags ?? 0;
  if (!node.tare || node.tare.undone) return "not tared";
  if (!node.calibration) return "no calibration";
  if (bits & (ESTIMATE.TILE_MISSING | ESTIMATE.SATURATED)) return whyNot(node, frame);
  if (frame.contact === false) return "no contact";
  if ((frame.contact ?? null) === null) return "contact unknown";
  if (bits & ESTIMATE.COP_MASKED) return "too uncertain";
  if (row.x !== null && row.y !== null) return "all tiles at one place";
  return "not determined";
}
