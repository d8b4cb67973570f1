// Differences between the stances of two sessions.

import { byId, el, number, setText } from "../common/text.js";
import { taresText } from "./header.js";
import { FIGURES, isMajority, valuesOf } from "./stances.js";

const STANCES_MIN = 3; // of each session: fewer do not bound their scatter
const Z = 1.96;
const LENGTHS = new Set(["duration", "travel"]);

/** Return count, mean and variance of values. @param {number[]} values */
export function momentsOf(values) {
  const count = values.length;
  const mean = values.reduce((sum, value) => sum + value, 0) / count;
  return { count, mean, variance: values.reduce((sum, value) => sum + (value - mean) ** 2, 0) / (count - 1) };
}

/** Return the 97.5 % quantile of Student's t: Cornish-Fisher expansion, 3 % low at 2 degrees of freedom. */
const quantileOf = (freedom) => Z + (Z ** 3 + Z) / (4 * freedom) + (5 * Z ** 5 + 16 * Z ** 3 + 3 * Z) / (96 * freedom ** 2)
  + (3 * Z ** 7 + 19 * Z ** 5 + 17 * Z ** 3 - 15 * Z) / (384 * freedom ** 3);

/** Return `newer` minus `older` and half of its 95 % interval (Welch), NaN without scatter; null: too few stances. */
export function differenceOf(older, newer) {
  if (Math.min(older.count, newer.count) < STANCES_MIN) return null;
  const [a, b] = [older.variance / older.count, newer.variance / newer.count];
  const freedom = (a + b) ** 2 / (a ** 2 / (older.count - 1) + b ** 2 / (newer.count - 1));
  return { mean: newer.mean - older.mean, half: quantileOf(freedom) * Math.sqrt(a + b) };
}

/** Return decimals, `least` or more, with which a difference is that of the values as shown. */
function decimalsFor(own, other, least) {
  const agrees = (decimals) => {
    const shown = (value) => Number(value.toFixed(decimals));
    return Math.abs(shown(other) - shown(own) - shown(other - own)) < 0.5 * 10 ** -decimals;
  };
  return [0, 1, 2].map((more) => least + more).find(agrees) ?? least + 2;
}

/** State tares that differ: they move the zero of all forces of a session. @param {Compared[]} sessions */
function drawTares(sessions) {
  const keys = sessions.map(({ tares }) => JSON.stringify(tares.map(({ t_ns: t }) => t)));
  setText(byId("differences-tares"), keys[0] === keys[1] ? ""
    : `Different tares, which shift all forces of a session: ${sessions.map(({ name, tares }) => `${name}: ${taresText(tares) || "none"}`).join("; ")}.`);
}

/**
 * State the differences beyond their 95 % interval, and fill the table with the whole stances of two sessions.
 * @typedef {{name: string, stances: any[], tares: ArrayView["tares"]}} Compared
 * @param {Compared} older @param {Compared} newer
 */
export function drawDifferences(older, newer) {
  const sessions = [older, newer].map(({ name, stances }) => ({ name, all: stances, stances: stances.filter((stance) => stance.is_whole) }));
  byId("differences-card").hidden = false;
  sessions.forEach(({ name, stances }, i) => byId(`differences-${i}`).replaceChildren(
    el("span", { cls: "session-name", text: name, title: name }), ` (${stances.length}), ±\u00a0sd`));
  drawTares([older, newer]);
  const differing = [];
  byId("differences-rows").replaceChildren(...FIGURES.map((figure) => {
    const { key, label, unit, factor, decimals } = figure;
    const both = sessions.map(({ stances, all }) => {
      const values = valuesOf(stances, figure);
      return momentsOf(isMajority(values, all) ? values : []);
    });
    const difference = differenceOf(both[0], both[1]);
    const places = difference ? decimalsFor(both[0].mean * factor, both[1].mean * factor, decimals) : decimals;
    const text = (mean, spread) => (Number.isFinite(mean) ? `${number(mean * factor, places)}${Number.isFinite(spread) ? ` ± ${number(spread * factor, places)}` : ""}` : "–");
    if (difference && Math.abs(difference.mean) > difference.half) {
      const [more, less] = LENGTHS.has(key) ? ["longer", "shorter"] : ["greater", "smaller"];
      const name = label.replace(/^[A-Z](?=[a-z])/, (letter) => letter.toLowerCase());
      differing.push(`${name} ${difference.mean > 0 ? more : less} by ${number(Math.abs(difference.mean) * factor, places)} ${unit}`);
    }
    return el("tr", { "data-figure": key }, el("th", { scope: "row", text: `${label}, ${unit}` }),
      ...both.map(({ mean, variance }) => el("td", { text: text(mean, Math.sqrt(variance)) })),
      el("td", { text: difference ? text(difference.mean, difference.half) : "–" }));
  }));
  const isKnown = sessions.every(({ stances, all }) => stances.length >= STANCES_MIN && isMajority(stances, all));
  setText(byId("differences-verdict"), !isKnown ? sessions.some(({ stances }) => stances.length < STANCES_MIN) ? `No differences: each session needs ${STANCES_MIN} whole stances.` : "No differences: less than half of the stances of a session are whole."
    : differing.length ? `Different at 95 %: ${differing.join(", ")} (${newer.name} against ${older.name}).` : "No figure differs at 95 %.");
  byId("differences-about").hidden = !isKnown;
}
