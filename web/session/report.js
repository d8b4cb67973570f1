// What foottile compare found of a session and a reference, in plain words.

import { byId, el, number, setText } from "../common/text.js";

/**
 * Figures of docs/compare.md: in words, unit, factor from SI, and decimals where these are not by size.
 * @type {[name: string, words: string, unit: string, factor: number, decimals?: number][]}
 */
const FIGURES = [
  ["grf_bias_n", "Force: our mean error", "N", 1],
  ["grf_mae_n", "Force: our mean absolute error", "N", 1],
  ["grf_rmse_n", "Force: our root mean square error", "N", 1],
  ["grf_r2", "Force: part of the reference's variance that ours explains (R²)", "", 1, 4],
  ["grf_coverage_95", "Force: part of the frames within the 95 % interval", "%", 100],
  ["grf_lag_n", "Force: of the error, what the lag's uncertainty may make", "N", 1],
  ["grf_frames", "Force: frames under load that are judged", "", 1, 0],
  ["stances", "Stances compared", "", 1, 0],
  ["peak_bias_n", "Peak of a stance: our mean error", "N", 1],
  ["peak_mae_n", "Peak of a stance: our mean absolute error", "N", 1],
  ["impulse_bias_n_s", "Impulse of a stance: our mean error", "N s", 1],
  ["impulse_mae_n_s", "Impulse of a stance: our mean absolute error", "N s", 1],
  ["contact_bias_s", "First contact: how much later ours is", "ms", 1e3],
  ["contact_mae_s", "First contact: mean absolute difference", "ms", 1e3],
  ["lift_off_bias_s", "Lift-off: how much later ours is", "ms", 1e3],
  ["lift_off_mae_s", "Lift-off: mean absolute difference", "ms", 1e3],
  ["cop_mean_m", "COP: mean distance", "mm", 1e3],
  ["cop_p95_m", "COP: 95 % of the frames are nearer than", "mm", 1e3],
  ["cop_bias_x_m", "COP: our mean error forward", "mm", 1e3],
  ["cop_bias_y_m", "COP: our mean error to the left", "mm", 1e3],
  ["cop_p95_about_mean_m", "COP: the same without the mean error", "mm", 1e3],
  ["cop_coverage_x_95", "COP: part within the 95 % interval, forward", "%", 100],
  ["cop_coverage_y_95", "COP: part within the 95 % interval, to the left", "%", 100],
];

const known = (value) => typeof value === "number" && Number.isFinite(value);

/** Three digits that count, as far as a unit needs them. */
function shown(value, unit, factor, fixed) {
  if (!known(value)) return "not known";
  const scaled = value * factor;
  const decimals = fixed ?? Math.max(0, Math.min(3, 2 - Math.floor(Math.log10(Math.abs(scaled) || 1))));
  return `${number(scaled, decimals)} ${unit}`.trim();
}

const between = (interval, unit, factor, fixed) =>
  (Array.isArray(interval) ? `${shown(interval[0], unit, factor, fixed)} to ${shown(interval[1], unit, factor, fixed)}` : "–");

/** "250.1 ms of it (95 %: 249.7 to 250.5 ms)" */
const certain = ({ value, interval_95: [low, high] }, unit, factor, decimals, of = "") =>
  `${number(value * factor, decimals)} ${unit}${of} (95 %: ${number(low * factor, decimals)} to ${number(high * factor, decimals)} ${unit})`;

/** @param {ComparisonReport} report */
function alignmentWords({ alignment, contact_n: contactN, trials_are: trialsAre, trials }) {
  const parts = [];
  const { lag_s: lag, scale, offset_in_flight_n: zero, offset_removed: removed } = alignment;
  if (lag) parts.push(`Its clock is ${certain(lag, "ms", 1e3, 1, " ahead of the session's")}, which is taken off.`);
  if (scale) parts.push(`One newton of it is ${certain(scale, "N", 1, 3, " of ours")}; nothing is scaled by that.`);
  if (zero) parts.push(`In flight it reads ${certain(zero, "N", 1, 2)}, ${removed ? "which is taken off" : "which is not taken off"}.`);
  if (known(contactN)) parts.push(`It bears load from ${shown(contactN, "N", 1)} on.`);
  if (trialsAre && trials) parts.push(`Trials: ${trialsAre}; ${trials.length} of them.`);
  return parts.join(" ");
}

/** @param {{name: string, is_of_these_frames: boolean | null, is_proven: boolean, missed: string[], report: ComparisonReport}} found */
export function drawReport(found) {
  const { report } = found;
  const limits = report.limits ?? {};
  byId("report-card").hidden = false;
  setText(byId("report-title"), `Against ${report.reference}`);
  const doubts = [];
  if (found.is_of_these_frames === false) doubts.push("It was compared with other frames than these: compare again.");
  if (!found.is_proven) doubts.push("Nothing proves that this report is as it was written.");
  const judged = Object.keys(limits).length;
  if (judged) doubts.push(found.missed.length ? `${found.missed.length} of ${judged} limits missed.` : `All limits met: ${judged}.`);
  setText(byId("report-says"), [...doubts, alignmentWords(report), "Errors are ours less the reference."].join(" "));
  byId("report-rows").replaceChildren(...FIGURES.filter(([name]) => report.figures[name] && (known(report.figures[name].mean) || name in limits)).map(([name, what, unit, factor, fixed]) => {
    const figure = report.figures[name];
    const limit = limits[name];
    const missed = name in limits && !(known(figure.mean) && Math.abs(figure.mean) <= limit);
    const verdict = name in limits ? `${missed ? "missed" : "met"}: ${shown(limit, unit, factor, fixed)}` : "";
    return el("tr", { "data-figure": name, "data-missed": String(missed) },
      el("td", { text: what }), el("td", { text: shown(figure.mean, unit, factor, fixed) }),
      el("td", { text: between(figure.interval_95, unit, factor, fixed) }), el("td", { text: String(figure.trials) }), el("td", { text: verdict }));
  }));
  byId("report-notes").replaceChildren(...report.notes.map((note) => el("li", { text: String(note) })));
}
