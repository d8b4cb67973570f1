// Result of a calibration: table of weights, curve with its band, accept or repeat.

import { decimalsOf, ticks } from "../common/axes.js";
import { svg } from "../common/svg.js";
import { byId, el, localTime, number, setText } from "../common/text.js";
import { plainWeight, signed } from "./guide.js";

const [WIDTH, HEIGHT] = [400, 270];
const EDGE = { left: 44, right: 10, top: 26, bottom: 40 };

/** Panel of an ended calibration. */
export class Result {
  /** @param {{onAccept: (id: string) => void, onSave: () => void, onRestart: () => void}} actions */
  constructor({ onAccept, onSave, onRestart }) {
    this.element = byId("result");
    /** @type {string | null} */
    this.shown = null;
    this.id = "";
    byId("accept").addEventListener("click", () => onAccept(this.id));
    byId("save").addEventListener("click", onSave);
    byId("restart").addEventListener("click", onRestart);
  }

  /** Redraw at the next call. */
  reset() {
    this.shown = null;
  }

  /** Draw an ended calibration; null hides the panel. @param {WeighingView | null} weighing @param {string} node */
  draw(weighing, node) {
    const wasHidden = this.element.hidden && weighing !== null;
    this.element.hidden = weighing === null;
    const key = weighing && JSON.stringify([weighing.session_id, weighing.state, weighing.result, node]);
    if (!weighing || key === this.shown) return;
    this.shown = key;
    const { result } = weighing;
    this.id = result?.calibration_id ?? "";
    setText(byId("result-title"), result ? result.name : "No calibration");
    setText(byId("problem"), weighing.problem ?? "");
    const refused = Object.entries(result?.refused ?? {}).map(([serial, reason]) => `No curve for ${serial}: ${reason}`);
    setText(byId("about"), result ? `Reference: ${weighing.reference}, ${tolerances(weighing.weights)}; ${localTime(new Date(result.date))}.` : "");
    byId("curves").replaceChildren(...refused.map((text) => el("p", { cls: "state bad", text })), ...(result?.tiles ?? []).map(card));
    byId("legend").hidden = !result;
    setText(byId("misfit"), result?.misfit ? `Does not fit ${node}: ${result.misfit}.` : "");
    byId("accept").hidden = !result || Boolean(result.misfit);
    setText(byId("accept"), `Accept and use for ${node}`);
    setText(byId("save"), result ? "Save only" : "Close");
    const link = byId("recorded", HTMLAnchorElement);
    link.href = `/sessions/${encodeURIComponent(weighing.session_id)}`;
    if (wasHidden) byId("result-title").focus();
  }
}

/** Return the number of weights and their tolerances as text. @param {string[]} labels */
function tolerances(labels) {
  const distinct = [...new Set(labels.map((label) => `±${label.split(" +-")[1] ?? "?"}`))];
  return `${labels.length} weights within ${distinct.join(", ")}`;
}

/** Make the card of a tile: table and curve. @param {TileResultView} tile */
function card(tile) {
  const rows = tile.weights.map((row) => {
    // A residual outside the interval points to a wrong or misplaced weight.
    const isOutlier = Math.abs(row.residual_n) > row.half_width_n;
    return el("tr", { "data-outlier": String(isOutlier) },
      el("td", { text: plainWeight(row.weight) }), el("td", { text: number(row.force_n, 2) }), el("td", { text: number(row.gauge_kpa, 2) }),
      el("td", { text: number(row.noise_kpa, row.noise_kpa < 0.01 ? 4 : 2) }), el("td", { text: signed(row.settle_kpa, 2) }),
      el("td", { cls: "residual", text: signed(row.residual_n, 2) }), el("td", { text: `±${number(row.half_width_n, 2)}` }));
  });
  const head = ["Weight", "Force|N", "Pressure|kPa", "Noise|kPa", "Settled|kPa", "Residual|N", "95 %|N"].map((text) => {
    const [title, unit] = text.split("|");
    return el("th", { scope: "col" }, title, ...(unit ? [el("br"), el("span", { cls: "unit", text: unit })] : []));
  });
  return el("section", { cls: "curve-card", "aria-label": `Tile ${tile.serial}` },
    el("h3", { text: `Tile ${tile.serial}` }),
    el("table", {}, el("thead", {}, el("tr", {}, ...head)), el("tbody", {}, ...rows)),
    curve(tile));
}

/** Plot force over pressure with its band. @param {TileResultView} tile */
function curve({ serial, weights, band }) {
  const box = svg("svg", { class: "curve", viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: "img", "aria-label": `Force of tile ${serial} over pressure, with its 95 % band` });
  const [maxKpa, maxN] = [Math.max(...band.map((p) => p.gauge_kpa)), Math.max(...band.map((p) => p.force_n + p.half_width_n))];
  const x = (kpa) => EDGE.left + (WIDTH - EDGE.left - EDGE.right) * kpa / maxKpa;
  const y = (n) => HEIGHT - EDGE.bottom - (HEIGHT - EDGE.top - EDGE.bottom) * n / maxN;
  const line = (points) => points.map(([kpa, n]) => `${x(kpa).toFixed(1)},${y(n).toFixed(1)}`).join(" ");
  const [across, up] = [ticks(0, maxKpa, 5), ticks(0, maxN, 5)];
  for (const kpa of across.values) {
    box.append(svg("line", { class: "grid", x1: x(kpa), x2: x(kpa), y1: EDGE.top, y2: HEIGHT - EDGE.bottom }),
      svg("text", { x: x(kpa), y: HEIGHT - EDGE.bottom + 16, "text-anchor": "middle" }, number(kpa, decimalsOf(across.step))));
  }
  for (const n of up.values) {
    box.append(svg("line", { class: "grid", x1: EDGE.left, x2: WIDTH - EDGE.right, y1: y(n), y2: y(n) }),
      svg("text", { x: EDGE.left - 6, y: y(n) + 4, "text-anchor": "end" }, number(n, decimalsOf(up.step))));
  }
  box.append(
    svg("polygon", { class: "area", points: `${line(band.map((p) => [p.gauge_kpa, p.force_n + p.half_width_n]))} ${line(band.map((p) => [p.gauge_kpa, Math.max(0, p.force_n - p.half_width_n)]).reverse())}` }),
    svg("polyline", { class: "line", points: line(band.map((p) => [p.gauge_kpa, p.force_n])) }),
    ...weights.map((row) => svg("circle", { cx: x(row.gauge_kpa), cy: y(row.force_n), r: 4 })),
    svg("text", { x: WIDTH - EDGE.right, y: HEIGHT - 6, "text-anchor": "end" }, "Pressure / kPa"),
    svg("text", { x: EDGE.left, y: EDGE.top - 10 }, "Force / N, with 95 % band"),
  );
  return box;
}
