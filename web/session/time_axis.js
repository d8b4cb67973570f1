// A session's one time axis: the node's date may have been set between two parts, so instants are moved part by part. Pure.

/** @typedef {{part: number, shift_ns: number, by: "node" | "server" | "joined"}[]} TimeAxis of GET /sessions/ID/overview */

const shiftOf = (/** @type {TimeAxis} */ axis, part) => axis[Math.min(part, axis.length - 1)].shift_ns;

/** Stances with their instants on the axis. */
export function stancesOn(axis, stances) {
  return stances.map((stance) => {
    const shiftNs = shiftOf(axis, stance.part);
    return {
      ...stance, begin_t_ns: stance.begin_t_ns + shiftNs, end_t_ns: stance.end_t_ns + shiftNs,
      peak_t_ns: stance.peak_t_ns === null ? null : stance.peak_t_ns + shiftNs,
    };
  });
}

/** The clock summary of a session, as if the node's date had been the axis. `parts` are the session's. */
export function clockOn(axis, parts, summary) {
  if (!summary) return summary;
  const streams = summary.streams.map((stream) => {
    const shiftNs = shiftOf(axis, Math.max(0, parts.findIndex(({ boot_id: id }) => id === stream.boot_id)));
    const moved = (tNs) => (tNs === null ? null : tNs + shiftNs);
    return {
      ...stream,
      stretches: stream.stretches.map((stretch) => ({
        ...stretch, begin_t_ns: moved(stretch.begin_t_ns), end_t_ns: moved(stretch.end_t_ns), offset_ns: stretch.offset_ns - shiftNs,
      })),
    };
  });
  return { ...summary, streams };
}

/** What a person should know of the axis; empty: the node's date was right. */
export function axisWords(axis) {
  if (axis.every(({ shift_ns: shiftNs }) => shiftNs === 0)) return "";
  const how = axis.some(({ by }) => by === "joined")
    ? "Its clock was not compared with the server's on both sides, so how long lay between is not known: one follows the other here."
    : "They are on one axis here by the server's clock.";
  return `The date of the node was set between two parts of this recording. ${how}`;
}
