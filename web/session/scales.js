// Axis ranges of the plots. Pure.

const PEAK_PX = 24; // above a peak, for its triangle and value
const BAND_SHARE = 0.5; // of the range of the values: so far a band extends the axis on each side

/** @typedef {{low: number, high: number, empty?: boolean}} Scale */

/**
 * Return the range of each panel in view; panels of a group share one. The values make it: a band that is wider
 * than they are extends it only so far that they keep half of it.
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
    const own = panel.besideOnly ? null : bins.extremes(...panel.columns, begin, end);
    for (const found of [own, plots.beside?.extremes(panel.key, view)]) {
      if (!found) continue;
      scale.low = Math.min(scale.low, found.low * factor);
      scale.high = Math.max(scale.high, found.high * factor);
    }
    if (panel.bound) scale.high = Math.max(scale.high, bins.extremes(panel.bound, panel.bound, begin, end)?.high ?? 0);
    const band = panel.band && bins.extremes(...panel.band, begin, end);
    if (band) {
      const room = BAND_SHARE * Math.max(scale.high - scale.low, panel.least);
      scale.low = Math.max(scale.low - room, Math.min(scale.low, band.low * factor));
      scale.high = Math.min(scale.high + room, Math.max(scale.high, band.high * factor));
    }
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
