// Stances: table, and figures of the selected one.

import { byId, el, number, setData, setText } from "../common/text.js";
import { estimateTexts } from "./flags.js";
import { timeText } from "./overlay.js";

const FORCE_SEEN_PX = 280; // head, GRF plot, and the buttons below it on a phone
const ROWS_MAX = 200; // per page
const EDGE_S = 1e-9; // rounding
const ORDINARY = ~(4 | 8 | 16 | 64); // outliers, gaps (counted below), COP at the edges, assumed scale

/** Return stances with times in seconds after the first frame. */
export function withSeconds(stances, beginNs) {
  return stances.map((stance) => ({
    ...stance, from: (stance.begin_t_ns - beginNs) * 1e-9, to: (stance.end_t_ns - beginNs) * 1e-9,
    peakS: stance.peak_t_ns === null ? null : (stance.peak_t_ns - beginNs) * 1e-9,
  }));
}

const isCut = (stance) => stance.begun === false || stance.ended === false;

/** Return the faults of a stance as texts. */
function flagsOf(stance) {
  const texts = estimateTexts(stance.estimate_flags & ORDINARY);
  if (!stance.begun) texts.push("start not recorded");
  if (!stance.ended) texts.push("end not recorded");
  if (stance.begun && stance.ended && stance.duration_sigma_s === null) texts.push("touchdown or lift-off too slow: contact time has no interval");
  if (stance.gap_s) texts.push(`${number(1e3 * stance.gap_s, 0)}\u00a0ms without frames${stance.peak_sigma_n === null ? ", which may hide the peak" : ""}`);
  if (stance.missing_frames) texts.push(`${stance.missing_frames} frames missing`);
  if (stance.unknown_frames) texts.push(`${stance.unknown_frames} frames without a GRF`);
  return texts;
}

/** Make the sign of a stance's faults: the worst in a few words; all of them in its title and to screen readers. */
function faultSign(stance) {
  const texts = flagsOf(stance);
  if (!texts.length) return "";
  const ends = [stance.begun ? "" : "start", stance.ended ? "" : "end"].filter(Boolean).join(" and ");
  const words = ends ? `cut at ${ends}` : stance.gap_s ? "gaps" : texts[0].split(/:| \(/)[0];
  const text = texts.join(", ");
  return el("small", { cls: "why", title: text }, el("span", { "aria-hidden": "true", text: `⚠ ${words}` }), el("span", { cls: "unseen", text }));
}

/** Return the index of the stance at an instant; -1: none. Stances are sorted by time. */
export function stanceAt(stances, timeS) {
  return timeS === null ? -1 : stances.findIndex(({ from, to }) => timeS >= from - EDGE_S && timeS <= to + EDGE_S);
}

/** Return the next or previous stance of the cursor; without a cursor the first or last in view. */
export function neighbour(stances, by, cursorS, view) {
  const here = stanceAt(stances, cursorS);
  if (here >= 0) return here + by;
  if (by > 0) return stances.findIndex((stance) => (cursorS === null ? stance.to >= view.from : stance.from > cursorS));
  return stances.findLastIndex((stance) => (cursorS === null ? stance.from <= view.to : stance.to < cursorS));
}

const Z95 = 1.96;
const BOUNDS = new Set(["peak", "travel"]); // lower bounds where they have no interval

/** Return whether a figure of a stance is a lower bound only. */
const isLowerBound = (stance, { key, sigma }) => isCut(stance) || (BOUNDS.has(key) && stance[sigma] === null);

/** Return the values of a figure over stances, without unknown ones and lower bounds. */
export const valuesOf = (stances, figure) => stances.filter((stance) => Number.isFinite(stance[figure.value]) && !isLowerBound(stance, figure))
  .map((stance) => stance[figure.value]);

/** Figures of a stance: label, value and sigma field, factor to the unit, decimals. */
export const FIGURES = [
  { key: "peak", label: "Peak force", value: "peak_grf_n", sigma: "peak_sigma_n", unit: "N", factor: 1, decimals: 1 },
  { key: "duration", label: "Contact time", value: "duration_s", sigma: "duration_sigma_s", unit: "ms", factor: 1e3, decimals: 0 },
  { key: "impulse", label: "Impulse", value: "impulse_n_s", sigma: "impulse_sigma_n_s", unit: "N\u00a0s", factor: 1, decimals: 2 },
  { key: "travel", label: "COP travel", value: "cop_x_range_m", sigma: "cop_x_range_sigma_m", unit: "mm", factor: 1e3, decimals: 1 },
];

/** Return value and half width of the 95 % interval, such as "25.6" and "± 1.0"; "≥ 25.6" of a lower bound, "–" for ≥ 0. */
export function figureOf(stance, figure) {
  const { value, sigma, factor, decimals } = figure;
  const [of, sigmaOf] = [stance[value] ?? null, stance[sigma] ?? null];
  const isBound = isLowerBound(stance, figure);
  if (of === null || (isBound && Number((of * factor).toFixed(decimals)) <= 0)) return ["–", ""];
  return [
    `${isBound ? "≥\u00a0" : ""}${number(of * factor, decimals)}`,
    sigmaOf === null ? "" : `±\u00a0${number(Z95 * sigmaOf * factor, decimals)}`,
  ];
}

/** Return whether some of all stances speak for all: a few may be of another kind. @param {unknown[]} some @param {unknown[]} all */
export const isMajority = (some, all) => 2 * some.length > all.length;

/** Return the median of each figure over the whole ones of all stances, as a stance; null where fewer than half have it. */
export function medianOf(stances) {
  const whole = stances.filter((stance) => stance.is_whole);
  const middle = (figure) => {
    const values = valuesOf(whole, figure).sort((a, b) => a - b);
    const half = values.length >> 1;
    return isMajority(values, stances) ? (values[half] + values[values.length - 1 - half]) / 2 : null;
  };
  return Object.fromEntries(FIGURES.map((figure) => [figure.value, middle(figure)]));
}

/** Return why medians of stances are not stated; empty if all are. */
function whyNoMedian(stances) {
  const whole = stances.filter((stance) => stance.is_whole);
  if (isMajority(whole, stances)) {
    const median = medianOf(stances);
    const lacking = FIGURES.filter((figure) => median[figure.value] === null).map(({ label }) => label);
    return lacking.length ? `no median: ${lacking.join(", ")}, unknown or a lower bound in most stances` : "";
  }
  const cut = stances.filter(isCut).length;
  const parts = [[cut, "cut"], [stances.length - whole.length - cut, "with gaps or saturated"]].filter(([many]) => many);
  return `no medians: only ${whole.length} whole; ${parts.map(([many, what]) => `${many.toLocaleString("en-GB")} ${what}`).join(", ")}`;
}

/** Table of stances. */
export class Stances {
  /** @param {(index: number) => void} onGo @param {number | null} selected number of a stance; null: none */
  constructor(onGo, selected = null) {
    this.onGo = onGo;
    this.selected = selected;
    this.body = byId("stances-rows");
    this.stances = [];
    this.drawn = null; // index of the stance on display, -1: none; null: nothing is drawn yet
    this.line = byId("stance-text");
    this.figures = new Map(FIGURES.map(({ key }) => [key, el("dd")]));
    byId("stance-figures").replaceChildren(...FIGURES.map(({ key, label }) => el("div", { "data-figure": key }, el("dt", { text: label }), this.figures.get(key))));
    byId("stances-more").addEventListener("click", () => this.add());
  }

  /** Return the index of the selected stance; -1: none. */
  get current() { return this.stances.findIndex((stance) => stance.number === this.selected); }

  show(stances) {
    this.stances = stances;
    if (stances.length && this.current < 0) this.selected = null; // of a URL: there is no such stance
    this.body.replaceChildren();
    this.drawn = null;
    for (const id of ["stances-card", "stance-line"]) byId(id).hidden = !stances.length;
    this.add();
  }

  add() {
    const have = this.body.children.length;
    for (const [i, stance] of this.stances.slice(have, have + ROWS_MAX).entries()) this.body.append(this.row(stance, have + i));
    byId("stances-more").hidden = this.body.children.length >= this.stances.length;
  }

  row(stance, index) {
    const go = el("button", { type: "button", cls: "small", text: String(stance.number), "aria-label": `Show stance ${stance.number}` });
    const row = el("tr", { role: "row", "data-stance": String(stance.number) },
      el("td", { role: "cell" }, go),
      ...FIGURES.map((figure) => {
        const [value, interval] = figureOf(stance, figure);
        return el("td", { role: "cell" }, `${value} `, el("small", { text: interval }));
      }),
      el("td", { role: "cell" }, timeText(stance.from, 0.01), faultSign(stance)));
    row.addEventListener("click", () => this.onGo(index));
    return row;
  }

  step(by, cursorS, view) {
    const { current } = this;
    const next = current >= 0 ? current + by : neighbour(this.stances, by, cursorS, view);
    if (next in this.stances) this.onGo(next);
  }

  /** Show the selected stance, and highlight it in the table. */
  draw() {
    const index = this.current;
    if (index === this.drawn) return;
    this.showFigures(this.stances[index]);
    this.drawn = index;
    while (index >= this.body.children.length) this.add();
    for (const row of this.body.querySelectorAll("[aria-current]")) row.removeAttribute("aria-current");
    const row = /** @type {HTMLElement | undefined} */ (this.body.children[index]);
    row?.setAttribute("aria-current", "true");
    if (!row) return;
    // Scroll the table only: the plots stay visible.
    const box = byId("stances-scroll");
    const [top, bottom] = [row.offsetTop, row.offsetTop + row.offsetHeight];
    if (top - 40 < box.scrollTop) box.scrollTop = top - 40;
    else if (bottom > box.scrollTop + box.clientHeight) box.scrollTop = bottom - box.clientHeight;
  }

  showFigures(stance) {
    const many = this.stances.length.toLocaleString("en-GB");
    const whole = this.stances.filter((one) => one.is_whole);
    const all = `${many} stance${many === "1" ? "" : "s"}`;
    const hasMedian = whole.length > 1 && isMajority(whole, this.stances);
    setText(byId("stance-which"), stance ? `Stance ${stance.number} of ${many}` : hasMedian ? `${all}, median of ${whole.length.toLocaleString("en-GB")} whole` : all);
    byId("stance-level").hidden = !stance;
    const shown = stance ?? medianOf(this.stances);
    for (const figure of FIGURES) {
      const [value, interval] = figureOf(shown, figure);
      setText(this.figures.get(figure.key), [value, interval, figure.unit].filter(Boolean).join("\u00a0"));
    }
    setText(byId("stance-flags"), stance ? flagsOf(stance).join(", ") : this.stances.length ? whyNoMedian(this.stances) : "");
    setData(this.line, "stance", stance ? String(stance.number) : "");
  }

  /** Scroll figures and GRF into view. */
  bringIntoView() {
    const line = byId("stance-line");
    const seenToPx = byId("plots").getBoundingClientRect().top + FORCE_SEEN_PX;
    if (line.getBoundingClientRect().top < 0 || seenToPx > innerHeight) line.scrollIntoView();
  }
}
