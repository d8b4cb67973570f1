// Stances: a table of when the foot stood, and how hard, and the one that the cursor is in, in words above the plots.

import { byId, el, number, setData, setText } from "../common/text.js";
import { estimateWords } from "./flags.js";
import { timeWords } from "./overlay.js";

const FORCE_SEEN_PX = 280; // head, the plot of the force, and the buttons that stay below it on a phone
const AT_ONCE = 200; // an hour of walking has thousands
const EDGE_S = 1e-9; // of times that were added up
const ORDINARY = ~(4 | 8 | 16 | 64); // outliers, gaps (said by number), COP at the edges, scale of the session

/** In seconds after the session's first frame. */
export function placed(stances, beginNs) {
  return stances.map((stance) => ({
    ...stance, from: (stance.begin_t_ns - beginNs) * 1e-9, to: (stance.end_t_ns - beginNs) * 1e-9,
    peakS: stance.peak_t_ns === null ? null : (stance.peak_t_ns - beginNs) * 1e-9,
  }));
}

function flagsOf(stance) {
  const words = estimateWords(stance.estimate_status & ORDINARY);
  if (!stance.begun) words.push("its beginning is not there");
  if (!stance.ended) words.push("its end is not there");
  if (stance.missing_frames) words.push(`${stance.missing_frames} frames not there`);
  if (stance.unknown_frames) words.push(`${stance.unknown_frames} frames without a GRF`);
  return words.join(", ");
}

/** The one that an instant is in; -1: none. Stances rise in time. */
export function stanceAt(stances, timeS) {
  return timeS === null ? -1 : stances.findIndex(({ from, to }) => timeS >= from - EDGE_S && timeS <= to + EDGE_S);
}

/** The next or previous one of the cursor's; without a cursor the first or last in view. */
export function neighbour(stances, by, cursorS, view) {
  const here = stanceAt(stances, cursorS);
  if (here >= 0) return here + by;
  if (by > 0) return stances.findIndex((stance) => (cursorS === null ? stance.to >= view.from : stance.from > cursorS));
  return stances.findLastIndex((stance) => (cursorS === null ? stance.from <= view.to : stance.to < cursorS));
}

const known = (value, decimals, unit, factor = 1) => (value === null ? "–" : `${number(value * factor, decimals)} ${unit}`);

/** What a stance is told by, in the table and above the plots. */
export const figuresOf = (stance) => ({
  duration: known(stance.duration_s, 0, "ms", 1e3),
  peak: known(stance.peak_grf_n, 1, "N") + (stance.peak_sigma_n === null ? "" : ` ± ${number(1.96 * stance.peak_sigma_n)}`),
  impulse: known(stance.impulse_n_s, 2, "N\u00a0s"), // in one line
});

function figuresInWords(stance) {
  const { duration, peak, impulse } = figuresOf(stance);
  const sure = stance.peak_sigma_n === null ? "" : "\u00a0(95\u00a0%)";
  return stance.peak_grf_n === null ? `force not known, ${duration}` : `peak ${peak}${sure}, ${duration}, ${impulse}`;
}

export class Stances {
  /** @param {(index: number) => void} onGo */
  constructor(onGo) {
    this.onGo = onGo;
    this.body = byId("stances-rows");
    this.stances = [];
    this.current = -1;
    this.says = byId("stance-says");
    byId("stances-more").addEventListener("click", () => this.add());
  }

  show(stances) {
    this.stances = stances;
    this.body.replaceChildren();
    this.current = -1;
    for (const id of ["stances-card", "stance-line"]) byId(id).hidden = !stances.length;
    setData(byId("plots-card"), "stances", String(stances.length > 0)); // for the style: :has() is newer than our browsers
    byId("stances-legend").textContent = `${stances.length} in all`;
    this.add();
  }

  add() {
    const have = this.body.children.length;
    for (const [i, stance] of this.stances.slice(have, have + AT_ONCE).entries()) this.body.append(this.row(stance, have + i));
    byId("stances-more").hidden = this.body.children.length >= this.stances.length;
  }

  row(stance, index) {
    const { duration, peak, impulse } = figuresOf(stance);
    const go = el("button", { type: "button", cls: "small", text: String(stance.number), "aria-label": `${stance.number}: show this stance` });
    const row = el("tr", { role: "row", "data-stance": String(stance.number) },
      el("td", { role: "cell" }, go),
      el("td", { role: "cell", text: timeWords(stance.from, 0.01) }),
      el("td", { role: "cell", text: duration }),
      el("td", { role: "cell", text: peak }),
      el("td", { role: "cell", text: impulse }),
      el("td", { role: "cell", text: known(stance.cop_x_range_m, 1, "mm", 1e3), "data-label": "COP travel" }),
      el("td", { role: "cell", cls: "why", text: flagsOf(stance) }));
    row.addEventListener("click", () => this.onGo(index));
    return row;
  }

  step(by, cursorS, view) {
    const next = neighbour(this.stances, by, cursorS, view);
    if (next in this.stances) this.onGo(next);
  }

  /** The one that the cursor is in is said, and marked in the table. */
  follow(timeS, isPlaying) {
    const index = stanceAt(this.stances, timeS);
    this.say(this.stances[index], isPlaying);
    if (index === this.current) return;
    this.current = index;
    while (index >= this.body.children.length) this.add();
    for (const row of this.body.querySelectorAll("[aria-current]")) row.removeAttribute("aria-current");
    const row = /** @type {HTMLElement | undefined} */ (this.body.children[index]);
    row?.setAttribute("aria-current", "true");
    if (!row) return;
    // Within its own box: the plots must stay in sight.
    const box = byId("stances-scroll");
    const [top, bottom] = [row.offsetTop, row.offsetTop + row.offsetHeight];
    if (top - 40 < box.scrollTop) box.scrollTop = top - 40;
    else if (bottom > box.scrollTop + box.clientHeight) box.scrollTop = bottom - box.clientHeight;
  }

  say(stance, isPlaying) {
    this.says.setAttribute("aria-live", isPlaying ? "off" : "polite"); // at four times the speed nobody can listen
    const many = this.stances.length.toLocaleString("en-GB");
    setText(byId("stance-which"), stance ? `Stance ${stance.number} of ${many}` : many === "1" ? "1 stance" : `Step through ${many} stances`);
    setText(byId("stance-figures"), stance ? figuresInWords(stance) : "");
    setText(byId("stance-flags"), stance ? flagsOf(stance) : "");
    setData(this.says, "stance", stance ? String(stance.number) : "");
  }

  /** Seen from a row, too, what is gone to has to come into view: its words, and the force below them. */
  bringIntoView() {
    const line = byId("stance-line");
    const seenToPx = byId("plots").getBoundingClientRect().top + FORCE_SEEN_PX;
    if (line.getBoundingClientRect().top < 0 || seenToPx > innerHeight) line.scrollIntoView();
  }
}
