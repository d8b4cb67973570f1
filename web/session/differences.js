// Differences between the stances of two sessions.

import { byId, el, number, setText } from "../common/text.js";
import { FIGURES } from "./stances.js";

const STANCES_MIN = 3; // of each session: fewer do not bound their scatter
const Z = 1.96;

/** Return count, mean and variance of a figure. */
export function momentsOf(stances, name) {
  const values = stances.map((stance) => stance[name]).filter(Number.isFinite);
  const count = values.length;
  const mean = values.reduce((sum, value) => sum + value, 0) / count;
  return { count, mean, variance: values.reduce((sum, value) => sum + (value - mean) ** 2, 0) / (count - 1) };
}

/** Return the 97.5 % quantile of Student's t: Cornish-Fisher expansion, 3 % low at 2 degrees of freedom. */
const quantileOf = (freedom) => Z + (Z ** 3 + Z) / (4 * freedom) + (5 * Z ** 5 + 16 * Z ** 3 + 3 * Z) / (96 * freedom ** 2)
  + (3 * Z ** 7 + 19 * Z ** 5 + 17 * Z ** 3 - 15 * Z) / (384 * freedom ** 3);

/** Return `other` minus `own` and half of its 95 % interval (Welch), NaN without scatter; null: too few stances. */
export function differenceOf(own, other) {
  if (Math.min(own.count, other.count) < STANCES_MIN) return null;
  const [a, b] = [own.variance / own.count, other.variance / other.count];
  const freedom = (a + b) ** 2 / (a ** 2 / (own.count - 1) + b ** 2 / (other.count - 1));
  return { mean: other.mean - own.mean, half: quantileOf(freedom) * Math.sqrt(a + b) };
}

/** Return decimals, `least` or more, with which a difference is that of the values as shown. */
function decimalsFor(own, other, least) {
  const agrees = (decimals) => {
    const shown = (value) => Number(value.toFixed(decimals));
    return Math.abs(shown(other) - shown(own) - shown(other - own)) < 0.5 * 10 ** -decimals;
  };
  return [0, 1, 2].map((more) => least + more).find(agrees) ?? least + 2;
}

/** Fill the table with whole stances of this and another session. @param {string} name of the other */
export function drawDifferences(stances, others, name) {
  const [own, other] = [stances, others].map((all) => all.filter((stance) => stance.is_whole));
  byId("differences-card").hidden = false;
  setText(byId("differences-about"), Math.min(own.length, other.length) < STANCES_MIN
    ? `No differences to ${name}: both sessions need ${STANCES_MIN} whole stances (${own.length} here, ${other.length} there).`
    : `Other: ${name}. sd: standard deviation of the stances; 95 %: interval of the difference of the means, from that scatter. An error that all stances share (calibration, tare) adds to it.`);
  setText(byId("differences-own"), `This (${own.length}), ±\u00a0sd`);
  setText(byId("differences-other"), `Other (${other.length}), ±\u00a0sd`);
  byId("differences-rows").replaceChildren(...FIGURES.map(({ key, label, value, unit, factor, decimals }) => {
    const both = [own, other].map((all) => momentsOf(all, value));
    const difference = differenceOf(both[0], both[1]);
    const places = difference ? decimalsFor(both[0].mean * factor, both[1].mean * factor, decimals) : decimals;
    const text = (mean, spread) => (Number.isFinite(mean) ? `${number(mean * factor, places)}${Number.isFinite(spread) ? ` ± ${number(spread * factor, places)}` : ""}` : "–");
    return el("tr", { "data-figure": key }, el("th", { scope: "row", text: `${label}, ${unit}` }),
      ...both.map(({ mean, variance }) => el("td", { text: text(mean, Math.sqrt(variance)) })),
      el("td", { text: difference ? text(difference.mean, difference.half) : "–" }));
  }));
}
