// Offset between the server's clock (markers) and the node's (frames), from GET /sessions/ID/clock. Pure.

/**
 * Return the server's UTC minus the node's, from the nearest stretch of measurements; null: not measured.
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
