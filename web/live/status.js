// Status line: rate, losses, latency, age of the last frame; live or frozen.

import { lossCounts } from "../common/losses.js";
import { byId, number, perSecond, roughly, setData, setText } from "../common/text.js";

const FROZEN_AFTER_MS = 600; // with a tick of 100 ms well within the promised second
const LATE_MS = 1000; // older frames do not show the present
const SHOWN_BACKLOG_S = 0.5; // less is in transit
const REFUSED_AFTER_MS = 2000; // the server does not record a node further behind
const SLOW = 0.9; // of the nominal rate; other load on the machine costs a little
const EVERY_MS = 250; // readable

/** Status line and the banner over stale data. */
export class Status {
  constructor(link) {
    this.link = link;
    this.live = false;
    this.isBlank = true; // no frame of this node ever
    this.writtenMs = 0;
    this.delayMs = null;
    this.cannotRecord = ""; // reason, as a sentence
  }

  clear() {
    this.delayMs = null;
    this.writtenMs = 0;
  }

  /** Update the latency. */
  addFrame(frame) {
    const halfMs = (this.link.roundTripMs ?? 0) / 2;
    const delayMs = Number.isFinite(frame.age_ms) ? Math.max(0, frame.age_ms) + halfMs : null;
    const steady = delayMs !== null && this.delayMs !== null && Math.abs(delayMs - this.delayMs) < 200;
    this.delayMs = steady ? 0.9 * this.delayMs + 0.1 * delayMs : delayMs;
  }

  /** Show whether data are live; return true while they are. */
  draw(node, received, nowMs, serverNowMs) {
    const sinceMs = silence(node, received, nowMs, serverNowMs);
    this.isBlank = sinceMs === null;
    const late = this.delayMs !== null && this.delayMs > LATE_MS;
    const live = !isFrozen(sinceMs) && !late;
    const banner = byId("frozen");
    setData(document.body, "live", String(live));
    setData(document.body, "linked", String(this.link.open && !this.link.serverSilent));
    banner.hidden = live;
    if (!live) {
      const frozen = isFrozen(sinceMs);
      setText(byId("frozen-text"), !frozen ? `Display is ${number(this.delayMs / 1000)} s behind`
        : sinceMs === null ? "No data yet" : `No data for ${sinceMs < 90_000 ? `${number(sinceMs / 1000)} s` : roughly(sinceMs / 1000)}`);
      setText(byId("frozen-reason"), frozen ? this.reason(node) : "The network is slower than the frame rate.");
    }
    const refused = !this.link.open || !node.connected || sinceMs === null || sinceMs > REFUSED_AFTER_MS;
    this.cannotRecord = !live && refused ? this.reason(node) : "";
    if (live !== this.live) {
      this.live = live;
      // Once: a screen reader would never finish the counting banner.
      setText(byId("announce"), live ? "Data are live." : `No data. ${this.reason(node)}`);
    }
    if (!live || nowMs - this.writtenMs > EVERY_MS) {
      this.writtenMs = nowMs;
      this.numbers(node, received, sinceMs);
    }
    return live;
  }

  reason(node) {
    if (!this.link.open) {
      return `Server link down${this.link.closeReason ? ` (${this.link.closeReason})` : ""}; reconnecting.`;
    }
    if (this.link.serverSilent) return "The server does not respond.";
    if (!node.connected) return `Node ${node.node} is offline.`;
    return `Node ${node.node} is connected but sends no frames.`;
  }

  numbers(node, received, sinceMs) {
    const beat = received.heartbeat ?? {};
    const frozen = isFrozen(sinceMs); // counts are those of then
    const rateHz = frozen ? null : beat.rate_hz ?? node.rate_hz;
    const nominalHz = node.nominal_rate_hz;
    const slow = rateHz !== null && nominalHz && rateHz < SLOW * nominalHz;
    // Above the nominal rate: the nominal rate is wrong, so it is left out.
    const of = rateHz !== null && rateHz <= nominalHz ? ` of ${perSecond(nominalHz)}` : "";
    write("rate", `${perSecond(rateHz ?? NaN)}${of}`, slow, frozen);
    const lost = beat.lost_frames ?? node.lost_frames ?? 0;
    const backlog = beat.backlog_frames ?? node.backlog_frames ?? 0;
    const missed = beat.missed_slots ?? node.missed_slots ?? 0;
    write("lost", lossCounts(lost, missed), lost > 0 || slow, frozen);
    byId("backlog-box").hidden = backlog < SHOWN_BACKLOG_S * (nominalHz || 400);
    write("backlog", `${backlog.toLocaleString("en-GB")} frames`, false, frozen);
    const delayMs = frozen ? null : this.delayMs;
    write("latency", delayMs === null ? "unknown" : `${number(delayMs, 0)} ms`, delayMs > 250, frozen);
    const ageS = sinceMs === null ? null : (sinceMs + (this.delayMs ?? 0)) / 1000;
    const ago = ageS !== null && ageS < 10 ? `${number(ageS, 2)} s ago` : `${roughly(ageS ?? 0)} ago`;
    write("age", ageS === null ? "none" : ago, ageS === null || ageS > 1);
  }
}

/** Return true if no frames come. @param {number | null} sinceMs */
const isFrozen = (sinceMs) => sinceMs === null || sinceMs > FROZEN_AFTER_MS;

/** Write a value; `stale`: it is old or unknown. */
function write(id, text, bad, stale = false) {
  const element = byId(id);
  setText(element, text);
  setData(element, "bad", String(Boolean(bad)));
  setData(element, "stale", String(stale));
}

/**
 * Return milliseconds since the latest frame: received here or, before the first, by the server.
 * Null if the node has never sent one.
 */
function silence(node, received, nowMs, serverNowMs) {
  if (received.frameMs !== null) return nowMs - received.frameMs;
  return node.last_seen_t_ns ? Math.max(serverNowMs - node.last_seen_t_ns / 1e6, nowMs - received.sinceMs) : null;
}
