// Time axis of a session: the node's clock may have been set between parts, so each part has its shift. Pure.

const shiftOf = (/** @type {PartShift[]} */ axis, part) => axis[Math.min(part, axis.length - 1)].shift_ns;

/** Return stances with times on the axis. */
export function moveStances(axis, stances) {
  return stances.map((stance) => {
    const shiftNs = shiftOf(axis, stance.part);
    return {
      ...stance, begin_t_ns: stance.begin_t_ns + shiftNs, end_t_ns: stance.end_t_ns + shiftNs,
      peak_t_ns: stance.peak_t_ns === null ? null : stance.peak_t_ns + shiftNs,
    };
  });
}

/** Return the clock summary of a session on the axis. `parts` are the session's. */
export function moveClock(axis, parts, summary) {
  if (!summary) return summary;
  const streams = summary.streams.map((stream) => {
    const shiftNs = shiftOf(axis, Math.max(0, parts.findIndex(({ stream_id: id }) => id === stream.stream_id)));
    const shift = (tNs) => (tNs === null ? null : tNs + shiftNs);
    return {
      ...stream,
      stretches: stream.stretches.map((stretch) => ({
        ...stretch, begin_t_ns: shift(stretch.begin_t_ns), end_t_ns: shift(stretch.end_t_ns), offset_ns: stretch.offset_ns - shiftNs,
      })),
    };
  });
  return { ...summary, streams };
}

/** Return a note on the axis; "": no shift. */
export function axisText(axis) {
  if (axis.every(({ shift_ns: shiftNs }) => shiftNs === 0)) return "";
  const how = axis.some(({ by }) => by === "joined")
    ? "The pause between them is unknown (clock offset not measured on both sides): they are joined."
    : "Parts are aligned by the server's clock.";
  return `The node's clock was set between two parts. ${how}`;
}
