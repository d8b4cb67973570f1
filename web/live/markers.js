// Queue of markers with the time of their press, for when the server cannot be reached.

import * as api from "../common/api.js";
import { notice } from "../common/notices.js";
import { byId, setText } from "../common/text.js";

const RETRY_MS = 2000;

/** Sends markers in order and retries while the server is down. */
export class MarkerQueue {
  /** @param {(id: string, event: object) => Promise<unknown>} [post] sends a marker of a session or a take */
  constructor(post = api.addMarker) {
    this.post = post;
    this.queue = [];
    this.sending = false;
    setInterval(() => this.send(), RETRY_MS);
    addEventListener("beforeunload", (event) => {
      if (this.queue.length) event.preventDefault(); // the browser asks whether to leave
    });
  }

  /** Queue a marker for sessions or takes; `serverMs` is an instant of the server's clock. */
  async add(sessions, label, serverMs) {
    const makeMarker = (session) => ({
      session,
      // Idempotent: a lost response does not create the marker twice.
      event: { label, t_ns: Math.round(serverMs) * 1e6, id: newId() },
    });
    this.queue.push(...sessions.map((session) => makeMarker(session)));
    this.draw();
    return this.send();
  }

  /** Send the queue; resolve to the markers that were stored. */
  async send() {
    if (this.sending || !this.queue.length) return [];
    this.sending = true;
    const sent = [];
    try {
      while (this.queue.length) {
        const marker = this.queue[0];
        try {
          await this.post(marker.session.id, marker.event);
          sent.push(marker);
        } catch (error) {
          if (!(error instanceof api.Refusal)) throw error;
          if (error.status === 0 || error.status === 401 || error.status >= 500) break; // retry later
          notice(`Marker “${marker.event.label}”: ${error.message}`, { bad: true });
        }
        this.queue.shift();
      }
    } finally {
      this.sending = false;
      this.draw();
    }
    return sent;
  }

  draw() {
    const marked = new Map(this.queue.map(({ event }) => [`${event.t_ns} ${event.label}`, event.label]));
    const count = marked.size;
    const box = byId("waiting-markers");
    box.hidden = !count;
    const labels = [...marked.values()].map((label) => `“${label}”`).join(", ");
    setText(box, count
      ? `${count === 1 ? "1 marker" : `${count} markers`} not sent yet, time kept: ${labels}. Closing this page loses ${count === 1 ? "it" : "them"}.`
      : "");
  }
}

function newId() {
  const random = crypto.getRandomValues(new Uint8Array(6));
  return [...random].map((byte) => byte.toString(16).padStart(2, "0")).join("");
}
