// By what two sessions can be laid over one another, and by how much that moves the other one. Pure.

import { offsetAt } from "./clock.js";

/**
 * @param {{beginNs: number, durationS: number, stances: {from: number, begun: boolean}[],
 *   marks: {label: string, timeS: number}[], offset: (tNs: number, ofServer: boolean) => number | null}} own
 * @param {{beginNs: number, durationS: number, stances: {begin_t_ns: number, begun: boolean}[],
 *   events: {label: string, t_ns: number}[], clock: Clock | null}} other
 * @returns {{key: string, says: string, because: string, shiftS: number}[]} the start first
 */
export function alignments(own, other) {
  const found = [{ key: "start", says: "start", because: "both begin at the same time", shiftS: 0 }];
  const mine = own.stances.find((stance) => stance.begun);
  const theirs = other.stances.find((stance) => stance.begun);
  if (mine && theirs) {
    found.push({
      key: "contact", says: "first contact", because: "the first contact that was seen to begin is at the same time in both",
      shiftS: mine.from - (theirs.begin_t_ns - other.beginNs) * 1e-9,
    });
  }
  const offsetOf = (tNs, ofServer) => (other.clock ? offsetAt(other.clock, tNs, ofServer) : null);
  const labels = new Set();
  for (const event of other.events) {
    const mark = own.marks.find(({ label }) => label === event.label);
    if (!mark || labels.has(event.label)) continue; // the first of its name counts
    labels.add(event.label);
    const theirsS = (event.t_ns - (offsetOf(event.t_ns, true) ?? 0) - other.beginNs) * 1e-9;
    found.push({
      key: `mark:${event.label}`, says: `mark “${event.label}”`, because: `the first mark “${event.label}” is at the same time in both`,
      shiftS: mark.timeS - theirsS,
    });
  }
  const [mineNs, theirsNs] = [own.offset(own.beginNs, false), offsetOf(other.beginNs, false)];
  if (mineNs !== null && theirsNs !== null) {
    const shiftS = (other.beginNs + theirsNs - own.beginNs - mineNs) * 1e-9;
    if (shiftS < own.durationS && shiftS + other.durationS > 0) { // else they were not recorded together
      found.push({ key: "clock", says: "clock", because: "what was at the same time by the server's clock is at the same time here", shiftS });
    }
  }
  return found;
}
