// Alignments of two sessions, and the time shift of each. Pure.

import { offsetAt } from "./clock.js";

/**
 * Return the possible alignments, the default first: of sessions that were recorded together the server's clock, in a
 * take without one the start; of others the first whole stance, else the start.
 * @param {{beginNs: number, durationS: number, take: string | null, stances: {from: number, is_whole: boolean}[],
 *   markers: {label: string, timeS: number}[], offset: (tNs: number, ofServer: boolean) => number | null}} own
 * @param {{beginNs: number, durationS: number, take: string | null, stances: {begin_t_ns: number, is_whole: boolean}[],
 *   events: {label: string, t_ns: number}[], clock: ClockSummary | null}} other
 * @returns {{key: string, label: string, meaning: string, shiftS: number}[]}
 */
export function alignments(own, other) {
  const isTake = own.take !== null && own.take === other.take;
  const found = [{
    key: "start", label: "start", shiftS: 0,
    meaning: isTake ? "each from its own first frame, which may be tenths of a second apart" : "each from its own first frame",
  }];
  const mine = own.stances.find((stance) => stance.is_whole);
  const theirs = other.stances.find((stance) => stance.is_whole);
  if (mine && theirs) {
    found[isTake ? "push" : "unshift"]({
      key: "contact", label: "first whole stance", meaning: "aligned at the first whole stance",
      shiftS: mine.from - (theirs.begin_t_ns - other.beginNs) * 1e-9,
    });
  }
  const offsetOf = (tNs, ofServer) => (other.clock ? offsetAt(other.clock, tNs, ofServer) : null);
  const labels = new Set();
  for (const event of other.events) {
    const marker = own.markers.find(({ label }) => label === event.label);
    if (!marker || labels.has(event.label)) continue; // the first of each label
    labels.add(event.label);
    const theirsS = (event.t_ns - (offsetOf(event.t_ns, true) ?? 0) - other.beginNs) * 1e-9;
    found.push({
      key: `marker:${event.label}`, label: `marker “${event.label}”`, meaning: `aligned at the first marker “${event.label}”`,
      shiftS: marker.timeS - theirsS,
    });
  }
  const [mineNs, theirsNs] = [own.offset(own.beginNs, false), offsetOf(other.beginNs, false)];
  if (mineNs !== null && theirsNs !== null) {
    const shiftS = (other.beginNs + theirsNs - own.beginNs - mineNs) * 1e-9;
    if (shiftS < own.durationS && shiftS + other.durationS > 0) { // else they were not recorded together
      found.unshift({ key: "clock", label: "clock", meaning: "aligned by the server's clock", shiftS });
    }
  }
  return found;
}
