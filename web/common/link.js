// The websocket: reconnects for ever, measures the round trip, and hands on parsed messages.

import { enter, keptOut, letIn, look } from "./login.js";
import { notice } from "./notices.js";

const FIRST_WAIT_S = 0.3;
const LONGEST_WAIT_S = 3;
const STEADY_AFTER_MS = 2000;
const PING_EVERY_MS = 1000;
const BLOCKED_AFTER = 3; // attempts that HTTP requests survive and the websocket does not
const BLOCKED = "the server answers, but its live link does not open: a proxy or a filter in between may not pass WebSockets";
const SILENT_AFTER_MS = 5000; // no message at all, although a heartbeat comes each second

export class Link {
  /** `onMessage(message)` per message, `onChange()` when the link opens or closes; `rateHz`: of frames. */
  constructor({ onMessage, onChange, rateHz = 30 }) {
    this.rateHz = rateHz;
    this.onMessage = onMessage;
    this.onChange = onChange;
    this.open = false;
    this.roundTripMs = null;
    this.unansweredSinceMs = null; // when the oldest ping without an answer was sent
    this.closeReason = "";
    this.socket = null;
    this.waitS = FIRST_WAIT_S;
    this.malformed = 0;
    this.retry = null;
    this.failures = 0; // attempts in a row that did not open
    this.software = null; // as this page found it first
    enter().finally(() => this.connect());
    setInterval(() => this.ping(), PING_EVERY_MS);
    // A phone back from sleep, or back in the WLAN, should not wait for the timer.
    addEventListener("online", () => this.hurry());
    document.addEventListener("visibilitychange", () => document.hidden || this.hurry());
    // Put aside by the browser and taken out again, this page has a socket that may be dead without saying so.
    addEventListener("pageshow", (event) => event.persisted && this.lost("this page was put aside"));
  }

  async connect() {
    clearTimeout(this.retry);
    this.retry = null;
    if (keptOut()) await letIn();
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const socket = new WebSocket(`${scheme}://${location.host}/api/v1/live?rate_hz=${this.rateHz}`, "foottile.v1");
    this.socket = socket;
    this.startedMs = performance.now();
    this.heardMs = this.startedMs;
    socket.onopen = () => {
      if (socket !== this.socket) return;
      this.open = true;
      this.failures = 0;
      this.heardMs = performance.now();
      this.unansweredSinceMs = null;
      this.onChange();
      this.ping();
    };
    socket.onmessage = (event) => {
      if (socket === this.socket) this.receive(event.data);
    };
    socket.onclose = (event) => {
      if (socket === this.socket) this.lost(event.reason);
    };
  }

  receive(data) {
    this.heardMs = performance.now();
    let message;
    try {
      message = JSON.parse(data);
    } catch {
      message = null;
    }
    if (message === null || typeof message !== "object") {
      if (this.malformed++ === 0) console.warn("FootTile: a malformed message was ignored");
      return;
    }
    // Only a connection that lasts proves the server well; one that opens and closes does not.
    if (this.heardMs - this.startedMs > STEADY_AFTER_MS) this.waitS = FIRST_WAIT_S;
    if (message.type === "pong") {
      const roundTripMs = performance.now() - message.t_ms;
      this.unansweredSinceMs = null;
      if (roundTripMs >= 0) {
        this.roundTripMs = this.roundTripMs === null ? roundTripMs : 0.7 * this.roundTripMs + 0.3 * roundTripMs;
      }
    }
    if (message.type === "hello") this.checkSoftware(message.software);
    this.onMessage(message);
  }

  /** Another version of the server may not understand the scripts of this one. */
  checkSoftware(software) {
    this.software ??= software;
    if (software === this.software) return;
    notice(`The server was changed from ${this.software} to ${software}, and this page is still the old one.`,
      { press: ["Load again", () => location.reload()], stays: true });
  }

  ping() {
    const nowMs = performance.now();
    if (this.socket && nowMs - this.heardMs > SILENT_AFTER_MS) {
      this.lost("the server fell silent");
      return;
    }
    if (!this.open || this.socket.bufferedAmount > 10_000) return;
    this.unansweredSinceMs ??= nowMs;
    this.socket.send(JSON.stringify({ type: "ping", t_ms: nowMs }));
  }

  lost(reason) {
    const socket = this.socket;
    if (!this.open) this.explain(); // was it refused, because a login is needed?
    this.socket = null;
    this.open = false;
    this.roundTripMs = null;
    this.unansweredSinceMs = null;
    this.closeReason = reason || (this.failures < BLOCKED_AFTER ? "" : this.closeReason);
    if (socket) {
      socket.onclose = socket.onmessage = socket.onopen = null;
      socket.close();
    }
    // Jitter, so that a room full of pages does not come back at one instant.
    this.retry = setTimeout(() => this.connect(), this.waitS * 1000 * (0.75 + 0.5 * Math.random()));
    this.waitS = Math.min(LONGEST_WAIT_S, this.waitS * 2);
    this.onChange();
  }

  async explain() {
    this.failures += 1;
    if (!await look() || this.open || this.failures < BLOCKED_AFTER) return;
    this.closeReason ||= BLOCKED;
    this.onChange();
  }

  hurry() {
    if (this.retry !== null && !this.socket) this.connect();
  }

  /** The server has owed an answer for longer than a second. */
  get serverSilent() {
    return this.unansweredSinceMs !== null && performance.now() - this.unansweredSinceMs > 1000;
  }
}
