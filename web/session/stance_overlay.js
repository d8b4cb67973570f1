// Overlay of whole stances: GRF and COP over 0 to 100 % of their duration; a click shows one.

import * as api from "../common/api.js";
import { coloursOf, fit, whenColoursChange } from "../common/axes.js";
import { drawArea, drawCurve, drawFrame, FRAME_COLOURS, roomy } from "../common/frame.js";
import { unlessRefused } from "../common/request.js";
import { byId, el, number, setData, setText } from "../common/text.js";
import { CopPaths } from "./cop_paths.js";

const HIT_PX = 18;
const GAP = 8; // of estimate_flags: frames are missing before
const FRAMES_MAX = 4000; // of the selected stance; a longer one is binned
const HEIGHT_PX = 320;

/** Plots of the overlay. */
export class StanceOverlay {
  /**
   * @param {string} id of the session
   * @param {{number: number, from: number, to: number, is_whole: boolean}[]} stances
   * @param {(index: number) => void} onGo
   */
  constructor(id, stances, onGo) {
    this.id = id;
    this.stances = stances;
    this.onGo = onGo;
    this.canvas = byId("overlay-canvas", HTMLCanvasElement);
    this.other = null; // other session
    this.beside = null; // its mean and spread
    this.chosen = null; // selected stance and its frames
    this.stopping = null; // of their request
    this.hover = null; // curve and percentage under the pointer
    this.paths = new CopPaths(() => this.draw(), (curve) => this.go(curve.number));
    const card = byId("overlay-card");
    card.hidden = false;
    // Load only when scrolled into view.
    const seen = new IntersectionObserver((entries) => {
      if (!entries.some((entry) => entry.isIntersecting)) return;
      seen.disconnect();
      this.load().catch((error) => this.refused(error));
    }, { rootMargin: "300px" });
    seen.observe(card);
    new ResizeObserver(() => this.draw()).observe(card);
    whenColoursChange(() => this.draw());
    this.canvas.addEventListener("pointermove", (event) => this.point(event));
    this.canvas.addEventListener("pointerleave", () => { this.hover = null; this.draw(); });
    this.canvas.addEventListener("click", (event) => {
      this.point(event);
      if (this.hover?.curve) this.go(this.hover.curve.number);
    });
  }

  async load() {
    const [answer, array] = await Promise.all([api.stancesOverlay(this.id), api.arrayOf(this.id)]);
    this.answer = answer;
    this.percent = percentOf(answer.points);
    this.paths.show(array.tiles, answer);
    setText(byId("overlay-summary"), this.summary());
    byId("overlay-plots").hidden = answer.overlaid === 0;
    this.draw();
  }

  /** Show mean and spread of another session's stances; null: none. @param {{id: string, name: string} | null} other */
  async setOverlay(other) {
    this.other = other;
    this.beside = null;
    this.draw();
    if (!other) return;
    const answer = await unlessRefused(api.stancesOverlay(other.id));
    if (this.other !== other || !answer?.overlaid) return;
    this.beside = { name: other.name, spread: answer.spread, overlaid: answer.overlaid, percent: percentOf(answer.points) };
    this.draw();
  }

  refused(error) {
    if (!(error instanceof api.Refusal)) throw error;
    setText(byId("overlay-summary"), error.message);
    byId("overlay-plots").hidden = true;
  }

  /** Return which stances are overlaid. */
  summary() {
    const { whole, overlaid, not_whole: cut, too_short: short, curves } = this.answer;
    const many = (n, what) => `${n.toLocaleString("en-GB")} ${what}${n === 1 ? "" : "s"}`;
    if (!overlaid) return "No whole stance to overlay.";
    const parts = [`${many(whole, "whole stance")}, first to last frame in contact.`];
    const of = overlaid < whole ? `${overlaid.toLocaleString("en-GB")}, evenly spaced` : "all";
    if (curves.length < whole) parts.push(`${curves.length} curves drawn, evenly spaced over the session; mean and SD of ${of}.`);
    if (cut) parts.push(`${many(cut, "incomplete stance")} left out.`);
    if (short) parts.push(`${many(short, "single-frame stance")} left out.`);
    if (overlaid === 1) parts.push("One stance: no SD.");
    return parts.join(" ");
  }

  go(wanted) {
    const index = this.stances.findIndex((stance) => stance.number === wanted);
    if (index >= 0) this.onGo(index);
  }

  /** Select a stance: drawn frame by frame over all others; -1: none. */
  async choose(index) {
    const stance = this.stances[index];
    if (stance?.number === this.chosen?.number) return;
    this.stopping?.abort();
    const stopping = this.stopping = new AbortController();
    const chosen = this.chosen = stance ? { number: stance.number, whole: stance.is_whole, bins: null } : null;
    this.draw();
    if (!chosen) return;
    try {
      const answer = await api.overview(this.id, {
        points: FRAMES_MAX, start_s: Math.max(0, stance.from - 1e-7), end_s: stance.to + 1e-6, columns: "grf_n,cop_x_m,cop_y_m,estimate_flags",
      }, stopping.signal);
      chosen.bins = answer.columns;
      chosen.framesInBin = answer.frames_in_bin;
    } catch (error) {
      if (stopping.signal.aborted) return;
      if (!(error instanceof api.Refusal)) throw error; // the thin curve stays
    }
    if (chosen === this.chosen) this.draw();
  }

  draw() {
    this.drawing ||= requestAnimationFrame(() => {
      this.drawing = 0;
      this.drawNow();
    });
  }

  drawNow() {
    const { answer, canvas } = this;
    const width = canvas.parentElement.clientWidth;
    if (!answer?.overlaid || width < 100) return;
    const colours = this.colours = coloursOf(canvas, FRAME_COLOURS);
    canvas.style.height = `${HEIGHT_PX}px`;
    const context = fit(canvas, width, HEIGHT_PX);
    const box = this.box = { left: 46, right: width - 14, top: 24, bottom: HEIGHT_PX - 44 };
    const { mean } = answer.spread.grf_n;
    const [low, high] = bandOf(answer.spread.grf_n);
    const theirs = this.beside ? bandOf(this.beside.spread.grf_n) : [];
    const frames = this.frames();
    const range = rangeOf([low, high, mean, ...theirs, ...answer.curves.map((curve) => curve.grf_n), ...(frames ? [frames.low, frames.high] : [])]);
    const { x, y } = drawFrame(context, box, {
      x: { low: 0, high: 100 }, y: roomy(range), colours, xUnit: "%", xTitle: "of stance", yTitle: "Ground reaction force, N",
    });
    this.y = y;
    const xs = this.percent.map(x);
    const rows = (values) => values.map((value) => (value === null ? null : y(value)));
    context.fillStyle = colours.interval;
    drawArea(context, xs, rows(low), rows(high));
    context.strokeStyle = colours.soft;
    context.globalAlpha = Math.max(0.25, Math.min(0.8, 8 / answer.curves.length));
    context.lineWidth = 1;
    for (const curve of answer.curves) drawCurve(context, xs, rows(curve.grf_n));
    context.globalAlpha = 1;
    context.lineJoin = "round";
    if (this.beside) {
      const at = this.beside.percent.map(x);
      context.fillStyle = context.strokeStyle = colours.other;
      context.globalAlpha = 0.25;
      drawArea(context, at, rows(theirs[0]), rows(theirs[1]));
      context.globalAlpha = 1;
      context.lineWidth = 2.5;
      drawCurve(context, at, rows(this.beside.spread.grf_n.mean));
    }
    context.strokeStyle = colours.text;
    context.lineWidth = 2.5;
    context.setLineDash([7, 4]);
    drawCurve(context, xs, rows(mean));
    context.setLineDash([]);
    if (this.hover?.curve) {
      context.strokeStyle = colours.series;
      context.lineWidth = 1.5;
      drawCurve(context, xs, rows(this.hover.curve.grf_n));
    }
    if (frames) {
      context.strokeStyle = context.fillStyle = colours.series;
      context.lineWidth = 2.5;
      const places = frames.percent.map(x);
      drawArea(context, places, rows(frames.low), rows(frames.high));
      drawCurve(context, places, rows(frames.high));
    }
    if (this.hover) {
      context.strokeStyle = colours.edge;
      context.lineWidth = 1;
      const at = x(this.percent[this.hover.at]);
      drawCurve(context, [at, at], [box.top, box.bottom]);
    }
    this.paths.draw(colours, this.chosen, frames, this.hover?.curve, this.beside);
    this.writeTexts();
  }

  writeTexts() {
    const { answer, chosen, hover } = this;
    const { mean, sd, count } = answer.spread.grf_n;
    const at = hover?.at ?? mean.reduce((best, value, i) => (value > (mean[best] ?? -Infinity) ? i : best), 0);
    const spread = sd[at] === null ? "" : ` (SD ${number(sd[at])} N)`;
    const where = `at ${number(this.percent[at], 0)} %`;
    const text = hover
      ? `${hover.curve ? `Stance ${hover.curve.number}: ${number(hover.curve.grf_n[at] ?? NaN)} N ${where}; mean` : `Mean ${where}:`} ${number(mean[at] ?? NaN)} N${spread}, n = ${count[at].toLocaleString("en-GB")}`
      : `Mean has its maximum ${where}: ${number(mean[at] ?? NaN)} N${spread}`;
    setText(byId("overlay-at"), text);
    const items = [["single", "single stances"], ["mean", "mean"]];
    if (answer.overlaid > 1) items.push(["spread", "± 1 SD over stances"]);
    if (this.beside) items.push(["beside", `${this.beside.name}: mean ± 1 SD over ${this.beside.overlaid.toLocaleString("en-GB")} stances`]);
    if (chosen) {
      const how = !chosen.whole ? " is incomplete: not drawn" : chosen.framesInBin > 1 ? ", min-max" : ", frame by frame";
      items.push(["chosen", `stance ${chosen.number}${how}`]);
    }
    const list = byId("overlay-legend");
    const key = JSON.stringify(items);
    setData(list, "chosen", chosen ? String(chosen.number) : "");
    if (list.dataset.key === key) return;
    list.dataset.key = key;
    list.replaceChildren(...items.map(([name, text]) => el("li", { "data-kind": name }, el("i", { cls: `swatch over-${name}`, "aria-hidden": "true" }), text)));
  }

  /** Return the frames of the selected stance over its duration; null: none, or not loaded. */
  frames() {
    const bins = this.chosen?.whole ? this.chosen.bins : null;
    if (!bins?.t_first_s.length) return null;
    const [begin, end] = [bins.t_first_s[0], bins.t_last_s.at(-1)];
    const shares = bins.t_first_s.map((timeS) => (100 * (timeS - begin)) / Math.max(1e-9, end - begin));
    // No line over a gap: an unknown value stands in it.
    const isGap = (i) => i > 0 && bins.estimate_flags[i] & GAP;
    const withGaps = (values, ofGap) => values.flatMap((value, i) => (isGap(i) ? [ofGap(i), value] : [value]));
    const [low, high, copX, copY] = ["grf_n_min", "grf_n_max", "cop_x_m_max", "cop_y_m_max"].map((name) => withGaps(bins[name], () => null));
    return { percent: withGaps(shares, (i) => (shares[i - 1] + shares[i]) / 2), low, high, copX, copY };
  }

  point(event) {
    const { answer, box } = this;
    if (!answer || !box) return;
    const [px, py] = [event.offsetX, event.offsetY];
    const share = (px - box.left) / (box.right - box.left);
    if (share < -0.02 || share > 1.02) { this.hover = null; return this.draw(); }
    const at = Math.round(Math.min(1, Math.max(0, share)) * (answer.points - 1));
    let best = { away: HIT_PX, curve: null };
    for (const curve of answer.curves) {
      const value = curve.grf_n[at];
      const away = value === null ? Infinity : Math.abs(this.y(value) - py);
      if (away < best.away) best = { away, curve };
    }
    this.hover = { at, curve: best.curve };
    this.canvas.style.cursor = best.curve ? "pointer" : "";
    this.draw();
  }
}

const percentOf = (points) => Array.from({ length: points }, (_, i) => (100 * i) / (points - 1));

/** Return mean minus and plus one standard deviation. */
const bandOf = ({ mean, sd }) => [-1, 1].map((sign) => mean.map((value, i) => (value === null || sd[i] === null ? null : value + sign * sd[i])));

/** Return the range of all series, with zero. */
function rangeOf(series) {
  const range = { low: 0, high: 0 };
  for (const values of series) {
    for (const value of values) {
      if (value === null) continue;
      if (value < range.low) range.low = value;
      if (value > range.high) range.high = value;
    }
  }
  return range;
}
