// Marks are in the server's UTC, frames in their node's: from one to the other by GET /sessions/ID/clock. Pure.

/**
 * Server's UTC minus the node's, by the stretch of measurements that is nearest; null if none was made.
 * @param {{streams: {stretches: {begin_t_ns: number | null, end_t_ns: number | null, offset_ns: number,
 *   drift_ppm: number | null}[]}[]}} summary
 * @param {number} tNs an instant @param {boolean} ofServer by the server's clock, else by the node's
 * @returns {number | null}
 */
export function offsetAt(summary, tNs, ofServer) {
  let best = null;
  for (const { stretches } of summary.streams) {
    for (const { begin_t_ns: begin, end_t_ns: end, offset_ns: offset, drift_ppm: drift } of stretches) {
      if (begin === null || end === null) continue;
      const t = ofServer ? tNs - offset : tNs;
      const away = Math.max(0, begin - t, t - end);
      if (best && away >= best.away) continue;
      best = { away, offset: offset + (drift ?? 0) * 1e-6 * (t - (begin + end) / 2) };
    }
  }
  return best?.offset ?? null;
}
