// Report of foottile compare on a session and a reference.

import { byId, el, number, setText } from "../common/text.js";

/**
 * Figures of docs/compare.md: label, unit, factor from SI; decimals if fixed.
 * @type {[name: string, label: string, unit: string, factor: number, decimals?: number][]}
 */
const FIGURES = [
  ["grf_bias_n", "GRF: mean error", "N", 1],
  ["grf_mae_n", "GRF: mean absolute error", "N", 1],
  ["grf_rmse_n", "GRF: RMS error", "N", 1],
  ["grf_r2", "GRF: R²", "", 1, 4],
  ["grf_coverage_95", "GRF: frames within the 95 % interval", "%", 100],
  ["grf_lag_n", "GRF: error from lag uncertainty", "N", 1],
  ["grf_frames", "GRF: loaded frames compared", "", 1, 0],
  ["stances", "Stances compared", "", 1, 0],
  ["peak_bias_n", "Stance peak: mean error", "N", 1],
  ["peak_mae_n", "Stance peak: mean absolute error", "N", 1],
  ["impulse_bias_n_s", "Stance impulse: mean error", "N s", 1],
  ["impulse_mae_n_s", "Stance impulse: mean absolute error", "N s", 1],
  ["contact_bias_s", "Touchdown: mean delay", "ms", 1e3],
  ["contact_mae_s", "Touchdown: mean absolute difference", "ms", 1e3],
  ["lift_off_bias_s", "Lift-off: mean delay", "ms", 1e3],
  ["lift_off_mae_s", "Lift-off: mean absolute difference", "ms", 1e3],
  ["cop_mean_m", "COP: mean distance", "mm", 1e3],
  ["cop_p95_m", "COP: 95th percentile of distance", "mm", 1e3],
  ["cop_bias_x_m", "COP: mean error, forward", "mm", 1e3],
  ["cop_bias_y_m", "COP: mean error, left", "mm", 1e3],
  ["cop_p95_about_mean_m", "COP: 95th percentile without mean error", "mm", 1e3],
  ["cop_coverage_x_95", "COP: within the 95 % interval, forward", "%", 100],
  ["cop_coverage_y_95", "COP: within the 95 % interval, left", "%", 100],
];

const known = (value) => typeof value === "number" && Number.isFinite(value);

/** Format with three significant digits, at most three decimals. */
function shown(value, unit, factor, fixed) {
  if (!known(value)) return "unknown";
  const scaled = value * factor;
  const decimals = fixed ?? Math.max(0, Math.min(3, 2 - Math.floor(Math.log10(Math.abs(scaled) || 1))));
  return `${number(scaled, decimals)} ${unit}`.trim();
}

const between = (interval, unit, factor, fixed) =>
  (Array.isArray(interval) ? `${shown(interval[0], unit, factor, fixed)} to ${shown(interval[1], unit, factor, fixed)}` : "–");

/** Format a value with its interval: "250.1 ms (95 %: 249.7 to 250.5 ms)". */
const certain = ({ value, interval_95: [low, high] }, unit, factor, decimals, of = "") =>
  `${number(value * factor, decimals)} ${unit}${of} (95 %: ${number(low * factor, decimals)} to ${number(high * factor, decimals)} ${unit})`;

/**
 * @typedef {{value: number, interval_95: [number, number]}} Estimate
 * @typedef {object} ComparisonReport of `foottile compare`: docs/compare.md
 * @property {string} reference
 * @property {Record<string, number>} [limits]
 * @property {string[]} notes
 * @property {number | null} contact_n
 * @property {Record<string, {mean: number | null, interval_95: [number, number] | null, trials: number}>} figures
 * @property {{lag_s?: Estimate, scale?: Estimate, offset_in_flight_n?: Estimate, offset_removed?: boolean}} alignment
 * @property {object[]} [trials]
 * @property {string} [trials_are]
 */

/** Return the alignment as text. @param {ComparisonReport} report */
function alignmentText({ alignment, contact_n: contactN, trials_are: trialsAre, trials }) {
  const parts = [];
  const { lag_s: lag, scale, offset_in_flight_n: zero, offset_removed: removed } = alignment;
  if (lag) parts.push(`Reference clock: ${certain(lag, "ms", 1e3, 1, " ahead")}, corrected.`);
  if (scale) parts.push(`Scale: 1 N of the reference is ${certain(scale, "N", 1, 3, " here")}, not corrected.`);
  if (zero) parts.push(`Offset in flight: ${certain(zero, "N", 1, 2)}, ${removed ? "corrected" : "not corrected"}.`);
  if (known(contactN)) parts.push(`Contact threshold: ${shown(contactN, "N", 1)}.`);
  if (trialsAre && trials) parts.push(`Trials (${trials.length}): ${trialsAre}.`);
  return parts.join(" ");
}

/** Draw the report. @param {Omit<ReportView, "report"> & {report: ComparisonReport}} found */
export function drawReport(found) {
  const { report } = found;
  const limits = report.limits ?? {};
  byId("report-card").hidden = false;
  setText(byId("report-title"), `Comparison with ${report.reference}`);
  const doubts = [];
  if (found.matches_current_data === false) doubts.push("The comparison used other frames: compare again.");
  const judged = Object.keys(limits).length;
  if (judged) doubts.push(found.missed.length ? `${found.missed.length} of ${judged} limits missed.` : `All ${judged} limits met.`);
  setText(byId("report-summary"), [...doubts, alignmentText(report), "Errors: FootTile minus reference."].join(" "));
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
