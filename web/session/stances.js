// The table of stances: when the foot stood, and how hard. A click goes there.

import { byId, el, number } from "../common/text.js";
import { estimateWords } from "./flags.js";
import { timeWords } from "./overlay.js";

const AT_ONCE = 200; // an hour of walking has thousands
const ORDINARY = ~(4 | 8 | 16 | 64); // outliers, gaps (said by number), COP at the edges, scale of the session

/** In seconds after the session's first frame. */
export function placed(stances, beginNs) {
  return stances.map((stance) => ({
    ...stance, from: (stance.begin_t_ns - beginNs) * 1e-9, to: (stance.end_t_ns - beginNs) * 1e-9,
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

export class Stances {
  /** @param {(index: number) => void} onGo */
  constructor(onGo) {
    this.onGo = onGo;
    this.body = byId("stances-rows");
    this.stances = [];
    this.current = -1;
    byId("stances-more").addEventListener("click", () => this.add());
  }

  show(stances) {
    this.stances = stances;
    this.body.replaceChildren();
    byId("stances-card").hidden = !stances.length;
    byId("stances-legend").textContent = `${stances.length} in all`;
    this.add();
  }

  add() {
    const have = this.body.children.length;
    for (const [i, stance] of this.stances.slice(have, have + AT_ONCE).entries()) this.body.append(this.row(stance, have + i));
    byId("stances-more").hidden = this.body.children.length >= this.stances.length;
  }

  row(stance, index) {
    const known = (value, decimals, unit, factor = 1) => (value === null ? "–" : `${number(value * factor, decimals)} ${unit}`);
    const go = el("button", { type: "button", cls: "small", text: String(stance.number), "aria-label": `${stance.number}: show this stance` });
    const peak = known(stance.peak_grf_n, 1, "N");
    const sure = stance.peak_sigma_n === null ? "" : ` ± ${number(1.96 * stance.peak_sigma_n)}`;
    const row = el("tr", { "data-stance": String(stance.number) },
      el("td", {}, go),
      el("td", { text: timeWords(stance.from, 0.01) }),
      el("td", { text: known(stance.duration_s, 0, "ms", 1e3) }),
      el("td", { text: peak + sure }),
      el("td", { text: known(stance.impulse_n_s, 2, "N s") }),
      el("td", { text: known(stance.cop_x_range_m, 1, "mm", 1e3) }),
      el("td", { cls: "why", text: flagsOf(stance) }));
    row.addEventListener("click", () => this.onGo(index));
    return row;
  }

  /** The next or previous one: of the one that was gone to, else of an instant. */
  step(by, timeS) {
    const { stances, current } = this;
    if (!stances.length) return;
    let next = current + by;
    if (current < 0) {
      const after = stances.findIndex((stance) => stance.from > timeS);
      next = by > 0 ? (after < 0 ? stances.length - 1 : after) : (after < 0 ? stances.length : after) - 1;
    }
    this.onGo(Math.min(stances.length - 1, Math.max(0, next)));
  }

  choose(index) {
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
}
