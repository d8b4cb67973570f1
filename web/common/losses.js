// Texts of lost frames and of slots that were not sampled.

const REASONS = {
  disk_full: "node disk full",
  read_only: "node disk read-only",
  disk_slow: "node disk too slow",
  node_busy: "node overloaded",
  evicted: "link down longer than the node's buffer",
  corrupt: "damaged on disk",
  node_restarted: "node restarted without them",
  abandoned: "session sealed without them",
  refused: "invalid, refused by the server",
};

const many = (count) => `${count.toLocaleString("en-GB")} frame${count === 1 ? "" : "s"}`;

/**
 * Return reason and text, such as ["disk_full", "12 frames: node disk full"], largest loss first.
 * @returns {[string, string][]}
 */
export function lossTexts(lost) {
  return Object.entries(lost ?? {})
    .filter(([, count]) => count > 0)
    .sort((a, b) => b[1] - a[1])
    .map(([reason, count]) => [reason, `${many(count)}: ${REASONS[reason] ?? reason.replaceAll("_", " ")}`]);
}

/** Return the share of a session's slots that were not sampled, 0 to 1. @param {SessionView} session */
export function missedShare({ frames: recorded, lost, missed_slots: missed }) {
  const slots = recorded + countLost(lost) + missed;
  return slots ? missed / slots : 0;
}

/** Return the share of slots that were not sampled, such as "12 % not sampled"; "" without any. @param {SessionView} session */
export function missedText(session) {
  const percent = 100 * missedShare(session);
  return percent ? `${percent < 1 ? "<1" : Math.round(percent)}\u00a0% not sampled` : "";
}

/** Return the number of lost frames. @param {Record<string, number>} [lost] by reason */
export const countLost = (lost) => Object.values(lost ?? {}).reduce((sum, count) => sum + count, 0);

/** Return both counts, such as "0 lost, 2,187 not sampled". @param {number} lost @param {number} missed */
export const lossCounts = (lost, missed) => `${lost.toLocaleString("en-GB")} lost, ${missed.toLocaleString("en-GB")} not sampled`;

export const LOSSES_HELP = "“0 lost, 12 not sampled”: lost frames were sampled, but did not arrive. Not sampled: the node’s computer was late and left "
  + "these slots out; all other frames are correct. “Complete”: nothing is lost. If many slots are not sampled, reduce other load on that computer.";

export { many as frames };
