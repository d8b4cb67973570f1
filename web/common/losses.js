// Texts of the ledger's reasons for lost frames.

const REASONS = {
  disk_full: "node disk full",
  read_only: "node disk read-only",
  disk_slow: "node disk too slow",
  node_busy: "node overloaded",
  evicted: "link down longer than the node's buffer",
  corrupt: "damaged on disk",
  node_restarted: "node restarted without them",
  given_up: "abandoned",
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

export { many as frames };
