// Running calibration: instruction, present pressure, completed steps.

import { decimalsOf, ticks } from "../common/axes.js";
import { svg } from "../common/svg.js";
import { byId, el, number, setData, setText } from "../common/text.js";

const TRACE_S = 20;
const BIN_S = 0.25;
const MIN_SPAN_KPA = 0.5; // noise at rest does not fill the plot
const [LEFT_PX, RIGHT_PX, BOTTOM_PX] = [58, 10, 24]; // margins of the plot, for labels

/** Return the weight of a marker label without its tolerance. @param {string} label */
export const plainWeight = (label) => label.split(" +-")[0];

/** Panel of the running calibration. */
export class Guide {
  /** @param {{onRepeat: () => void, onCancel: () => void}} actions */
  constructor({ onRepeat, onCancel }) {
    this.element = byId("guide");
    this.shown = "";
    this.longestS = 1;
    byId("repeat").addEventListener("click", onRepeat);
    byId("cancel").addEventListener("click", onCancel);
  }

  /** Draw the running calibration; null hides the panel. @param {WeighingView | null} weighing @param {boolean} isConnected */
  draw(weighing, isConnected) {
    const wasHidden = this.element.hidden && weighing !== null;
    this.element.hidden = weighing === null;
    if (!weighing) return;
    if (wasHidden) byId("prompt").focus();
    const isFitting = weighing.state === "fitting";
    const at = weighing.tiles.findIndex((tile) => tile.serial === weighing.tile);
    const { held } = weighing.tiles[at];
    const weightNumber = Math.min(held.length + 1, weighing.weights.length);
    setData(byId("instruction"), "step", isFitting ? "fitting" : weighing.step);
    setText(byId("progress"), isFitting ? weighing.name : `${weighing.tile}, weight ${weightNumber} of ${weighing.weights.length}`
      + (weighing.tiles.length > 1 ? `, tile ${at + 1} of ${weighing.tiles.length}` : ""));
    setText(byId("prompt-text"), isFitting ? "Fitting, readings pause. Unload the tile" : weighing.prompt);
    setText(byId("remaining"), weighing.left_s === null || isFitting ? "" : `: ${Math.ceil(weighing.left_s)} s`);
    this.drawBar(weighing, isFitting);
    setText(byId("warning"), isConnected ? (weighing.warning ? `Step repeated: ${weighing.warning}` : "") : "Node offline: waiting for it");
    const repeatability = weighing.left_s === null ? null : weighing.repeatability;
    setText(byId("pressure"), number(weighing.pressure_kpa ?? weighing.recent_kpa.at(-1), 2));
    setText(byId("spread"), number(repeatability?.spread_kpa, 3));
    setText(byId("settled"), repeatability ? signed(repeatability.settle_kpa, 2) : "–");
    const last = weighing.weights[weighing.step === "holding" ? held.length : held.length - 1];
    byId("repeat", HTMLButtonElement).disabled = isFitting || last === undefined;
    setText(byId("repeat"), last === undefined ? "Repeat" : `Repeat ${plainWeight(last)}`);
    drawTrace(byId("trace", SVGSVGElement), weighing);
    this.drawSteps(weighing, at, isFitting);
  }

  /** Draw the remaining time of a step. @param {WeighingView} weighing @param {boolean} isFitting */
  drawBar(weighing, isFitting) {
    const fill = byId("bar-fill");
    if (weighing.left_s === null || isFitting) {
      this.longestS = 0;
      fill.style.width = "";
      return;
    }
    this.longestS = Math.max(this.longestS, weighing.left_s);
    fill.style.width = `${100 * (1 - weighing.left_s / (this.longestS || 1))}%`;
  }

  /** Draw tiles and weights with their state. @param {WeighingView} weighing @param {number} at @param {boolean} isFitting */
  drawSteps(weighing, at, isFitting) {
    const key = JSON.stringify([weighing.session_id, at, weighing.tiles, isFitting]);
    if (key === this.shown) return;
    this.shown = key;
    byId("steps").replaceChildren(...weighing.tiles.map((tile, i) => {
      const isNow = i === at && !isFitting;
      const done = `${tile.held.length} of ${weighing.weights.length}`;
      return el("li", { "data-state": isNow ? "now" : "" },
        el("h2", {}, el("span", { text: tile.serial }), el("span", { cls: "value", text: done })),
        ...(isNow || tile.held.length ? [el("ol", {}, ...weighing.weights.map((weight, j) => stepItem(weight, tile.held[j], isNow && j === tile.held.length)))] : []));
    }));
    this.element.querySelector("li[data-state=now] li[data-state=now]")?.scrollIntoView({ block: "nearest" });
  }
}

/** Make the list item of a weight. @param {string} weight @param {RepeatabilityView | undefined} held @param {boolean} isNow */
function stepItem(weight, held, isNow) {
  const item = el("li", { "data-state": held ? "done" : isNow ? "now" : "next" }, el("span", { text: plainWeight(weight) }));
  if (held) item.append(el("span", { cls: "value", text: `${number(held.mean_kpa, 2)} kPa` }), el("span", { cls: "unseen", text: " done" }));
  return item;
}

/** Draw the pressure of the last seconds: above the rest, or absolute before the first rest. @param {SVGSVGElement} box @param {WeighingView} weighing */
function drawTrace(box, { recent_kpa: recent, rest_kpa: rest }) {
  const [width, height] = [box.clientWidth, box.clientHeight];
  box.setAttribute("viewBox", `0 0 ${width} ${height}`);
  const kpa = recent.map((value) => value - (rest ?? 0));
  if (kpa.length < 2 || !width) {
    box.replaceChildren();
    return;
  }
  const middle = (Math.min(...kpa) + Math.max(...kpa)) / 2;
  const half = Math.max(MIN_SPAN_KPA, Math.max(...kpa) - Math.min(...kpa)) / 2 * 1.15;
  const y = (value) => (height - BOTTOM_PX) * (0.5 - (value - middle) / (2 * half));
  const x = (ageS) => width - RIGHT_PX - (width - LEFT_PX - RIGHT_PX) * ageS / TRACE_S;
  const up = ticks(middle - half, middle + half, Math.max(2, height / 50));
  const grid = up.values.filter((value) => y(value) > 14).flatMap((value) => [
    svg("line", { class: "grid", x1: LEFT_PX, x2: width - RIGHT_PX, y1: y(value), y2: y(value) }),
    svg("text", { x: LEFT_PX - 6, y: y(value) + 4, "text-anchor": "end" }, number(value, decimalsOf(up.step))),
  ]);
  box.replaceChildren(
    ...grid,
    svg("polyline", { class: "line", points: kpa.map((value, i) => `${x((kpa.length - 1 - i) * BIN_S).toFixed(1)},${y(value).toFixed(1)}`).join(" ") }),
    svg("text", { x: 8, y: height - 6 }, rest === null ? "kPa, absolute" : "kPa above rest"),
    svg("text", { x: width - RIGHT_PX, y: height - 6, "text-anchor": "end" }, `last ${TRACE_S} s`),
  );
}

/** Format a number with its sign. @param {number} value @param {number} decimals */
export const signed = (value, decimals) => (value > 0 && Number(value.toFixed(decimals)) !== 0 ? "+" : "") + number(value, decimals);
