// How good the picture is: rate, loss, latency, age; and when it is no picture of now at all.

import { byId, number, perSecond, roughly, setData, setText } from "../common/text.js";

const FROZEN_AFTER_MS = 600; // with a tick of 100 ms well within the promised second
const LATE_MS = 1000; // frames that old when they arrive show the past
const SHOWN_BEHIND_S = 0.5; // what is on its way in good order is not behind
const REFUSED_AFTER_MS = 2000; // the server records no node that is further behind
const SLOW = 0.9; // of what the bus gives; a little less is what a machine does beside it
const EVERY_MS = 250; // numbers that change faster cannot be read

export class Status {
  constructor(link) {
    this.link = link;
    this.live = false;
    this.isBlank = true; // nothing has ever come from this node, as far as the server knows
    this.writtenMs = 0;
    this.delayMs = null;
    this.cannotRecord = ""; // why, in a sentence
  }

  clear() {
    this.delayMs = null;
    this.writtenMs = 0;
  }

  see(frame) {
    const halfMs = (this.link.roundTripMs ?? 0) / 2;
    const delayMs = Number.isFinite(frame.age_ms) ? Math.max(0, frame.age_ms) + halfMs : null;
    const steady = delayMs !== null && this.delayMs !== null && Math.abs(delayMs - this.delayMs) < 200;
    this.delayMs = steady ? 0.9 * this.delayMs + 0.1 * delayMs : delayMs;
  }

  /** Decide on live or frozen, and show it. Returns true while live. */
  draw(node, heard, nowMs, serverNowMs) {
    const sinceMs = silence(node, heard, nowMs, serverNowMs);
    this.isBlank = sinceMs === null;
    const late = this.delayMs !== null && this.delayMs > LATE_MS;
    const live = sinceMs !== null && sinceMs <= FROZEN_AFTER_MS && !late;
    const banner = byId("frozen");
    setData(document.body, "live", String(live));
    banner.hidden = live;
    if (!live) {
      const frozen = sinceMs === null || sinceMs > FROZEN_AFTER_MS;
      setText(byId("frozen-text"), !frozen ? `Picture is ${number(this.delayMs / 1000)} s late`
        : sinceMs === null ? "No data yet" : `No data for ${sinceMs < 90_000 ? `${number(sinceMs / 1000)} s` : roughly(sinceMs / 1000)}`);
      setText(byId("frozen-reason"), frozen ? this.reason(node) : "The network is slower than the frames come.");
    }
    const refused = !this.link.open || !node.connected || sinceMs === null || sinceMs > REFUSED_AFTER_MS;
    this.cannotRecord = !live && refused ? this.reason(node) : "";
    if (live !== this.live) {
      this.live = live;
      // Said once; the counting banner itself would never let a screen reader finish.
      setText(byId("announce"), live ? "Data are live." : `No data. ${this.reason(node)}`);
    }
    if (!live || nowMs - this.writtenMs > EVERY_MS) {
      this.writtenMs = nowMs;
      this.numbers(node, heard, sinceMs);
    }
    return live;
  }

  reason(node) {
    if (!this.link.open) {
      return `Link to the server is down${this.link.closeReason ? ` (${this.link.closeReason})` : ""}; trying again.`;
    }
    if (this.link.serverSilent) return "The server does not answer.";
    if (!node.connected) return `Node ${node.node} is away.`;
    return `Node ${node.node} is silent, though connected.`;
  }

  numbers(node, heard, sinceMs) {
    const beat = heard.beat ?? {};
    const rateHz = beat.rate_hz ?? node.rate_hz;
    const nominalHz = node.nominal_rate_hz;
    const slow = rateHz !== null && nominalHz && rateHz < SLOW * nominalHz;
    // A rate that proves the nominal one wrong stands alone.
    const of = rateHz !== null && rateHz <= nominalHz ? ` of ${perSecond(nominalHz)}` : "";
    write("rate", `${perSecond(rateHz ?? NaN)}${of}`, slow);
    const lost = beat.lost_frames ?? node.lost_frames ?? 0;
    const behind = beat.backlog_frames ?? node.backlog_frames ?? 0;
    const missed = beat.missed_slots ?? node.missed_slots ?? 0;
    write("lost", `${lost.toLocaleString("en-GB")}, ${missed.toLocaleString("en-GB")} not sampled`, lost > 0 || slow);
    byId("behind-box").hidden = behind < SHOWN_BEHIND_S * (nominalHz || 400);
    write("behind", `${behind.toLocaleString("en-GB")} frames, catching up`, false);
    write("latency", this.delayMs === null ? "unknown" : `${number(this.delayMs, 0)} ms`, this.delayMs > 250);
    const ageS = sinceMs === null ? null : (sinceMs + (this.delayMs ?? 0)) / 1000;
    const ago = ageS !== null && ageS < 10 ? `${number(ageS, 2)} s ago` : `${roughly(ageS ?? 0)} ago`;
    write("age", ageS === null ? "none yet" : ago, ageS === null || ageS > 1);
  }
}

function write(id, text, bad) {
  const element = byId(id);
  setText(element, text);
  setData(element, "bad", String(Boolean(bad)));
}

/**
 * Milliseconds since the newest frame came: here or, if this page has not seen one, by the server's word.
 * Null if the node has never sent one.
 */
function silence(node, heard, nowMs, serverNowMs) {
  if (heard.frameMs !== null) return nowMs - heard.frameMs;
  return node.last_seen_t_ns ? Math.max(serverNowMs - node.last_seen_t_ns / 1e6, nowMs - heard.sinceMs) : null;
}
