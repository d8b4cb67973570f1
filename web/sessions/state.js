// What has become of a session, in plain words.

import { frames, lossesInWords } from "../common/losses.js";

const WAITS = {
  frames: (session) => `${frames(session.pending_frames)} are still with the node; it completes by itself when they have come.`,
  end: () => "Only its end is open: what the node took last, until the stop, has not come yet. It completes by itself when it has.",
};

/** State and completeness in plain words: [short, long, how serious]. @param {Session} session */
export function plainState(session) {
  const why = session.problem ? ` ${session.problem}` : "";
  const losses = lossesInWords(session.lost).map((loss) => `${loss}.`);
  if (session.tail_frames_max) losses.push(`At most ${frames(session.tail_frames_max)} more may be missing where the node could not tell its end.`);
  const missing = losses.length ? ` Missing: ${losses.join(" ")}` : "";
  switch (session.state) {
    case "recording": return ["recording", missing.trim(), "run"];
    case "pending": {
      return ["pending", `${WAITS[session.waits_for]?.(session) ?? "All frames are here; it is sealed in a moment."}${missing}${why}`, "warn"];
    }
    case "sealing": return ["sealing", `Being written; Parquet follows.${missing}${why}`, "run"];
    case "sealed":
      if (session.complete === true) return ["complete", why.trim(), "good"];
      if (session.complete === "lossy") return ["lossy", `${missing.trim() || "Frames are missing for good."}${why}`, "warn"];
      return ["incomplete", why.trim() || "Not all frames have arrived.", "warn"];
    default: return [String(session.state), why.trim(), "warn"];
  }
}
