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

/** Return a share of slots in percent, such as "12 %"; "" for none. @param {number} share 0 to 1 */
export const percentText = (share) => (share ? `${share < 0.01 ? "<1" : Math.round(100 * share)}\u00a0%` : "");

/** Return the share of slots that were not sampled, such as "12 % not sampled"; "" without any. @param {{not_sampled_share: number}} session */
export const missedText = ({ not_sampled_share: share }) => (share ? `${percentText(share)} not sampled` : "");

/** Return the greatest share of slots that were not sampled. @param {{not_sampled_share: number}[]} sessions */
export const greatestShare = (sessions) => Math.max(0, ...sessions.map((session) => session.not_sampled_share));

export const MISSED_SHARE_MAX = 0.01; // more is a warning

/** Return the number of lost frames. @param {Record<string, number>} [lost] by reason */
export const countLost = (lost) => Object.values(lost ?? {}).reduce((sum, count) => sum + count, 0);

/** Return both counts, such as "0 lost, 2,187 not sampled". @param {number} lost @param {number} missed */
export const lossCounts = (lost, missed) => `${lost.toLocaleString("en-GB")} lost, ${missed.toLocaleString("en-GB")} not sampled`;

export const LOSSES_HELP = "“0 lost, 12 not sampled”: lost frames were sampled, but did not arrive. Not sampled: the node’s computer was late and left "
  + "these slots out; all other frames are correct. “Complete”: every frame that was sampled is stored; those that were not sampled are stated beside it. If many slots are not sampled, reduce other load on that computer.";

export { many as frames };
