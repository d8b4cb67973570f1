// Axis ranges of the plots. Pure.

const PEAK_PX = 24; // above a peak, for its triangle and value

/** @typedef {{low: number, high: number, empty?: boolean}} Scale */

/**
 * Return the range of each panel in view; panels of a group share one.
 * @param {import("./plots.js").Plots} plots @param {import("./view.js").View} view
 * @returns {Map<string, Scale>} by group, or key
 */
export function scalesOf(plots, view) {
  const bins = plots.best(view);
  const [begin, end] = bins.within(view);
  const scales = new Map();
  for (const panel of plots.panels) {
    if (panel.kind !== "series") continue;
    const factor = panel.factor ?? 1;
    const key = panel.group ?? panel.key;
    const scale = scales.get(key) ?? { low: panel.zero ? 0 : Infinity, high: panel.zero ? 0 : -Infinity };
    const own = panel.besideOnly ? [] : [panel.columns, panel.band].filter(Boolean);
    const all = own.map(([low, high]) => bins.extremes(low, high, begin, end));
    for (const found of [...all, plots.beside?.extremes(panel.key, view)]) {
      if (!found) continue;
      scale.low = Math.min(scale.low, found.low * factor);
      scale.high = Math.max(scale.high, found.high * factor);
    }
    if (panel.bound) scale.high = Math.max(scale.high, bins.extremes(panel.bound, panel.bound, begin, end)?.high ?? 0);
    scales.set(key, scale);
  }
  for (const scale of scales.values()) {
    if (!(scale.high >= scale.low)) Object.assign(scale, { low: 0, high: 1, empty: true });
    const room = Math.max(0.06 * (scale.high - scale.low), 1e-3, scale.high === scale.low ? 0.5 : 0);
    scale.high += room;
    scale.low -= scale.low === 0 ? 0 : room;
  }
  const force = plots.panels.find((panel) => panel.key === "grf");
  if (force) leaveRoomForPeaks(scales.get("grf"), plots.stances, view, plots.scaled(force));
  return scales;
}

/** @param {Scale} scale */
function leaveRoomForPeaks(scale, stances, view, heightPx) {
  for (const { peakS, peak_grf_n: peak } of stances) {
    if (peakS === null || peakS < view.from || peakS > view.to) continue;
    scale.high = Math.max(scale.high, peak + ((peak - scale.low) * PEAK_PX) / (heightPx - PEAK_PX));
  }
}
