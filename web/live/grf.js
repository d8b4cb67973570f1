// Ground reaction force with its uncertainty, or its lower bound.

import { ESTIMATE } from "../common/flags.js";
import { byId, number, plain, setData, setText } from "../common/text.js";

/** Show the GRF of a frame. */
export function drawGrf(node, frame) {
  const value = Number.isFinite(frame?.grf_n) ? frame.grf_n : null;
  // A foot does not pull: the bound is never below zero.
  const atLeast = value === null && Number.isFinite(frame?.grf_lower_bound_n) ? Math.max(0, Math.floor(frame.grf_lower_bound_n * 10) / 10) : null;
  const bits = frame?.estimate_flags ?? 0;
  const assumed = node.calibration?.absolute_scale === "assumed" || bits & ESTIMATE.ASSUMED_SCALE;
  setText(byId("grf"), number(value ?? atLeast ?? NaN));
  setData(byId("grf"), "value", plain(value));
  setText(byId("grf-bound"), atLeast === null ? "" : "at least ");
  setData(byId("grf-card"), "bound", String(atLeast !== null));
  setText(byId("grf-sigma"), value === null ? (atLeast === null ? whyNot(node, frame) : `(${whyNot(node, frame)})`)
    : Number.isFinite(frame.grf_sigma_n) ? `±\u00a0${number(1.96 * frame.grf_sigma_n)}\u00a0N (95\u00a0%)${assumed ? " assumed\u00a0scale" : ""}` : "");

  drawContact(byId("contact"), frame);
}

/** Show contact, flight or unknown, as text and by the style of `.contact`. */
export function drawContact(element, frame) {
  const contact = frame?.contact ?? null;
  setData(element, "contact", contact === null ? "" : String(contact));
  setText(element, contact === null ? "contact unknown" : contact ? "contact" : "flight");
}

/** Return the reason for no GRF. */
export function whyNot(node, frame) {
  if (!frame) return "no data";
  if (!node.tare || node.tare.undone) return "not tared";
  if (!node.calibration) return "no calibration";
  const bearing = node.tiles.map((tile, i) => ({ tile, i })).filter(({ tile }) => !tile.reference);
  const missing = bearing.filter(({ i }) => !Number.isFinite(frame.force_n?.[i]));
  if (missing.length === bearing.length && node.compiling) return "models are being compiled: pressures only";
  if (missing.length === bearing.length && bearing.some(({ i }) => Number.isFinite(frame.gauge_kpa?.[i]))) return "no estimate";
  const saturated = bearing.filter(({ i }) => frame.saturated?.[i]);
  const reasons = [tilesText(missing, bearing, "missing"), tilesText(saturated, bearing, "saturated")].filter(Boolean);
  return reasons.length ? reasons.join(", ") : "no value";
}

/** Return "T03 missing", or "4 tiles missing" for three and more. */
function tilesText(which, bearing, what) {
  if (!which.length) return "";
  if (which.length === bearing.length) return `all tiles ${what}`;
  const names = which.length < 3 ? which.map(({ tile }) => tile.serial).join(", ") : `${which.length} tiles`;
  return `${names} ${what}`;
}
