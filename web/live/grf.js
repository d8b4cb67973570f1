// The ground reaction force as one big number with its uncertainty, and whether the foot stands.

import { byId, number, plain, setData, setText } from "../common/text.js";
import { ESTIMATE } from "./tile.js";

export function drawGrf(node, frame) {
  const value = Number.isFinite(frame?.grf_n) ? frame.grf_n : null;
  const bits = frame?.estimate_status ?? 0;
  const assumed = node.calibration?.absolute_scale === "assumed" || bits & ESTIMATE.ASSUMED_SCALE;
  setText(byId("grf"), number(value ?? NaN));
  setData(byId("grf"), "value", plain(value));
  // A saturated tile bears at least what it shows, and so does the sum.
  setText(byId("grf-bound"), value !== null && bits & ESTIMATE.SATURATED ? "≥ " : "");
  setText(byId("grf-sigma"), value === null ? whyNot(node, frame)
    : Number.isFinite(frame.grf_sigma_n) ? `±\u00a0${number(1.96 * frame.grf_sigma_n)}\u00a0N (95\u00a0%)${assumed ? " assumed\u00a0scale" : ""}` : "");

  const contact = frame?.contact ?? null;
  const element = byId("contact");
  setData(element, "contact", contact === null ? "" : String(contact));
  setText(element, contact === null ? "contact unknown" : contact ? "contact" : "flight");
}

function whyNot(node, frame) {
  if (!frame) return "waiting";
  if (!node.tare || node.tare.undone) return "not tared";
  if (!node.calibration) return "no calibration";
  return frame.estimate_status & ESTIMATE.TILE_MISSING ? "tile missing" : "no value";
}
