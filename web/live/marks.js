// Marks keep the instant of the press, and wait here while the server cannot be reached.

import * as api from "../common/api.js";
import { notice } from "../common/notices.js";
import { byId, setText } from "../common/text.js";

const AGAIN_MS = 2000;

export class Marks {
  /** @param {(of: string, event: object) => Promise<unknown>} [post] gives a mark to the server: of a session, or of a take */
  constructor(post = api.markEvent) {
    this.post = post;
    this.waiting = [];
    this.sending = false;
    setInterval(() => this.send(), AGAIN_MS);
    addEventListener("beforeunload", (event) => {
      if (this.waiting.length) event.preventDefault(); // the browser asks whether to leave
    });
  }

  /** Mark these sessions, or takes, at an instant of the server's clock, in milliseconds. */
  async add(sessions, label, serverMs) {
    const waitingMark = (session) => ({
      session,
      // Its own id: if an answer is lost on the way, the same mark is not made twice.
      event: { label, t_ns: Math.round(serverMs) * 1e6, id: newId() },
    });
    this.waiting.push(...sessions.map((session) => waitingMark(session)));
    this.draw();
    return this.send();
  }

  /** Send what waits; resolves to the marks that were made. */
  async send() {
    if (this.sending || !this.waiting.length) return [];
    this.sending = true;
    const made = [];
    try {
      while (this.waiting.length) {
        const mark = this.waiting[0];
        try {
          await this.post(mark.session.id, mark.event);
          made.push(mark);
        } catch (error) {
          if (!(error instanceof api.Refusal)) throw error;
          if (error.status === 0 || error.status === 401 || error.status >= 500) break; // later
          notice(`Marker “${mark.event.label}”: ${error.message}`, { bad: true });
        }
        this.waiting.shift();
      }
    } finally {
      this.sending = false;
      this.draw();
    }
    return made;
  }

  draw() {
    const presses = new Map(this.waiting.map(({ event }) => [`${event.t_ns} ${event.label}`, event.label]));
    const count = presses.size;
    const box = byId("waiting-marks");
    box.hidden = !count;
    const labels = [...presses.values()].map((label) => `“${label}”`).join(", ");
    setText(box, count
      ? `${count === 1 ? "1 marker waits" : `${count} markers wait`} for the server, with the time of the press: ${labels}. Keep this page open, closing it loses ${count === 1 ? "it" : "them"}.`
      : "");
  }
}

function newId() {
  const random = crypto.getRandomValues(new Uint8Array(6));
  return [...random].map((byte) => byte.toString(16).padStart(2, "0")).join("");
}
