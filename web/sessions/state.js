// State of a session as text.

import { countLost, frames, lossCounts, lossTexts, MISSED_SHARE_MAX, missedText } from "../common/losses.js";

const WAITS = {
  frames: (session) => `${frames(session.pending_frames)} still on the node; sealed once they arrive.`,
  end: () => "Waiting for the last frames before stop.",
};

/** Explanation of a state's word, as a tooltip. @param {SessionView} session */
export const stateTitle = ({ complete }) => (complete === true ? "Complete: every frame that the node sampled is stored."
  : complete === "lossy" ? "Lossy: frames that the node sampled are lost." : "");

/** Return state and completeness: [label, details, severity]. @param {SessionView} session */
export function stateText(session) {
  const why = session.problem ? ` ${session.problem}` : "";
  const losses = lossTexts(session.lost).map(([, text]) => `${text}.`);
  if (session.max_lost_tail_frames) losses.push(`Up to ${frames(session.max_lost_tail_frames)} at the end may be lost (power failure).`);
  const missing = losses.length ? ` Missing: ${losses.join(" ")}` : "";
  const share = session.missed_slots ? `, ${missedText(session)}` : "";
  const missed = share ? `${lossCounts(countLost(session.lost), session.missed_slots)} (node late).` : "";
  switch (session.state) {
    case "recording": return [`recording${share}`, missing.trim(), "run"];
    case "pending": {
      return [`pending${share}`, `${WAITS[session.pending_reason]?.(session) ?? "All frames received; sealing."}${missing}${why}`, "warn"];
    }
    case "sealing": return [`sealing${share}`, `Writing files.${missing}${why}`, "run"];
    case "sealed":
      if (session.complete === true) return [`complete${share}`, `${missed}${why}`.trim(), session.not_sampled_share > MISSED_SHARE_MAX ? "warn" : "good"];
      if (session.complete === "lossy") return [`lossy${share}`, `${missing.trim() || "Frames are lost."}${missed && ` ${missed}`}${why}`, "warn"];
      return ["incomplete", why.trim() || "Not all frames have arrived.", "warn"];
    default: return [String(session.state), why.trim(), "warn"];
  }
}
