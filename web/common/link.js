// Websocket: reconnects, measures the round trip and the server's clock, passes on parsed messages.

import { logInFromUrl, needsLogin, waitForLogin, look } from "./login.js";
import { notice } from "./notices.js";

const FIRST_WAIT_S = 0.3;
const LONGEST_WAIT_S = 3;
const STEADY_AFTER_MS = 2000;
const PING_EVERY_MS = 1000;
const BLOCKED_AFTER = 3; // failed attempts while HTTP works
const BLOCKED = "the server responds, but a proxy or filter may block WebSockets";
const SILENT_AFTER_MS = 5000; // a heartbeat is due each second
const STALE_AFTER_MS = 2000; // after sleep: the socket may be dead, and a new one costs little

/** @typedef {{[T in PageMessage["type"]]?: (message: Extract<PageMessage, {type: T}>) => void}} Handlers */

/** Live connection to the server. */
export class Link {
  /**
   * `handlers`: by type of message; others are ignored. `watchers` get every message before them. `onChange()` at open
   * and close; `rateHz`: of frames.
   * @param {{handlers: Handlers, watchers?: ((message: PageMessage) => void)[], onChange?: () => void, rateHz?: number}} how
   */
  constructor({ handlers, watchers = [], onChange = () => {}, rateHz = 30 }) {
    this.rateHz = rateHz;
    this.watchers = watchers;
    this.handlers = handlers;
    this.onChange = onChange;
    this.serverAheadMs = 0;
    this.open = false;
    this.roundTripMs = null;
    this.unansweredSinceMs = null; // send time of the oldest unanswered ping
    this.closeReason = "";
    this.socket = null;
    this.waitS = FIRST_WAIT_S;
    this.malformed = 0;
    this.retry = null;
    this.failures = 0; // consecutive failed attempts
    this.software = null; // version at the first connection
    logInFromUrl().finally(() => this.connect());
    let tickMs = Date.now();
    setInterval(() => {
      if (Date.now() - tickMs > STALE_AFTER_MS + PING_EVERY_MS) this.wake(); // the timer slept
      tickMs = Date.now();
      this.ping();
    }, PING_EVERY_MS);
    // After sleep or loss of the network reconnect at once.
    addEventListener("online", () => this.wake());
    document.addEventListener("visibilitychange", () => document.hidden || this.wake());
    addEventListener("pageshow", ({ persisted }) => this.wake(persisted)); // the browser's cache closes sockets
  }

  async connect() {
    clearTimeout(this.retry);
    this.retry = null;
    if (needsLogin()) await waitForLogin();
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const socket = new WebSocket(`${scheme}://${location.host}/api/v1/live?rate_hz=${this.rateHz}`, "foottile.v1");
    this.socket = socket;
    this.startedMs = performance.now();
    this.note();
    socket.onopen = () => {
      if (socket !== this.socket) return;
      this.open = true;
      this.failures = 0;
      this.note();
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

  /** Store the time of a sign of life. */
  note() {
    this.receivedMs = performance.now();
    this.receivedDateMs = Date.now();
  }

  receive(data) {
    if (Date.now() - this.receivedDateMs > SILENT_AFTER_MS) return this.wake(); // messages from before a sleep
    this.note();
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
    // Only a lasting connection resets the delay.
    if (this.receivedMs - this.startedMs > STEADY_AFTER_MS) this.waitS = FIRST_WAIT_S;
    if (message.type === "pong") {
      const roundTripMs = performance.now() - message.t_ms;
      this.unansweredSinceMs = null;
      if (roundTripMs >= 0) {
        this.roundTripMs = this.roundTripMs === null ? roundTripMs : 0.7 * this.roundTripMs + 0.3 * roundTripMs;
      }
    }
    if (message.type === "hello") this.checkSoftware(message.software);
    if (Number.isFinite(message.t_ns) && ["hello", "heartbeat", "pong"].includes(message.type)) {
      // Sent half a round trip ago.
      this.serverAheadMs = message.t_ns / 1e6 + (this.roundTripMs ?? 0) / 2 - Date.now();
    }
    for (const watch of this.watchers) watch(message);
    // Types of a newer server are ignored.
    if (Object.hasOwn(this.handlers, message.type)) this.handlers[message.type](message);
  }

  /** Return the present time of the server, ms since 1970. */
  serverNowMs() {
    return Date.now() + this.serverAheadMs;
  }

  /** Offer a reload after an update of the server. */
  checkSoftware(software) {
    this.software ??= software;
    if (software === this.software) return;
    notice(`Server updated from ${this.software} to ${software}. Reload this page.`,
      { press: ["Reload", () => location.reload()], stays: true });
  }

  ping() {
    const nowMs = performance.now();
    if (this.socket && nowMs - this.receivedMs > SILENT_AFTER_MS) {
      this.lost("no messages");
      return;
    }
    if (!this.open || this.socket.bufferedAmount > 10_000) return;
    this.unansweredSinceMs ??= nowMs;
    this.socket.send(JSON.stringify({ type: "ping", t_ms: nowMs }));
  }

  lost(reason) {
    const socket = this.socket;
    if (!this.open) this.explain(); // may need a login
    this.socket = null;
    this.open = false;
    this.roundTripMs = null;
    this.unansweredSinceMs = null;
    this.closeReason = reason || (this.failures < BLOCKED_AFTER ? "" : this.closeReason);
    if (socket) {
      socket.onclose = socket.onmessage = socket.onopen = null;
      socket.close();
    }
    // Jitter spreads the reconnections of many pages.
    this.retry = setTimeout(() => this.connect(), this.waitS * 1000 * (0.75 + 0.5 * Math.random()));
    this.waitS = Math.min(LONGEST_WAIT_S, this.waitS * 2);
    this.onChange();
  }

  /** Find the reason of a failed attempt. */
  async explain() {
    this.failures += 1;
    if (!await look() || this.open || this.failures < BLOCKED_AFTER) return;
    this.closeReason ||= BLOCKED;
    this.onChange();
  }

  /** Reconnect at once if the socket is missing, dead or stale; some clocks stand still during sleep, the date does not. */
  wake(isDead = false) {
    const silentMs = Math.max(performance.now() - this.receivedMs, Date.now() - this.receivedDateMs);
    if (this.socket && (isDead || silentMs > STALE_AFTER_MS)) this.lost("no messages");
    if (this.retry === null || this.socket) return;
    this.waitS = FIRST_WAIT_S;
    this.connect();
  }

  /** True if a ping is unanswered for more than a second. */
  get serverSilent() {
    return this.unansweredSinceMs !== null && performance.now() - this.unansweredSinceMs > 1000;
  }
}
