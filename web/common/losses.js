// Why frames are missing, in words: the reasons of the server's ledger.

const REASONS = {
  disk_full: "the node's disk was full",
  read_only: "the node's disk was read-only",
  disk_slow: "the node's disk was too slow",
  node_busy: "the node was too busy to keep them",
  evicted: "the link was down for longer than the node could keep them",
  corrupt: "damaged on the disk",
  node_restarted: "the node came back without them",
  given_up: "sealed without them",
  refused: "refused by the server: no frame can be so",
};

const many = (count) => `${count.toLocaleString("en-GB")} frame${count === 1 ? "" : "s"}`;

/** ["12 frames: the node's disk was full", ...], the greatest loss first. */
export function lossesInWords(lost) {
  return Object.entries(lost ?? {})
    .filter(([, count]) => count > 0)
    .sort((a, b) => b[1] - a[1])
    .map(([reason, count]) => `${many(count)}: ${REASONS[reason] ?? reason.replaceAll("_", " ")}`);
}

export { many as frames };
