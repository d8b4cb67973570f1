// Latest session of the selected node: link and state, while none is recorded.

import * as api from "../common/api.js";
import { unlessRefused } from "../common/request.js";
import { byId, duration, el } from "../common/text.js";
import { stateText } from "../sessions/state.js";

/** Line about the latest session. */
export class LastSession {
  constructor() {
    this.box = byId("last-session");
    this.key = null;
    this.clear();
  }

  clear() {
    /** @type {Map<string, SessionView | null>} by node; null: none, or requested */
    this.newest = new Map();
  }

  /** Store a session if it is the latest of its node. @param {SessionView} session */
  update(session) {
    const stored = this.newest.get(session.node);
    if (stored && stored.id !== session.id && stored.started_t_ns > session.started_t_ns) return;
    if (stored?.id === session.id && stored.state === "sealed" && session.state !== "sealed") return; // outdated response
    this.newest.set(session.node, session);
  }

  /** Remove a deleted session; its node is requested again. @param {string} id */
  drop(id) {
    for (const [node, session] of this.newest) if (session?.id === id) this.newest.delete(node);
  }

  async load(node) {
    this.newest.set(node, null);
    const answer = await unlessRefused(api.listSessions({ limit: 1, node })); // the page shows that the server is down
    answer?.items.forEach((session) => this.update(session));
  }

  draw(node) {
    if (node && !this.newest.has(node.node)) this.load(node.node);
    const session = this.newest.get(node?.node) ?? null;
    const key = JSON.stringify(session);
    if (key === this.key) return;
    this.key = key;
    this.box.replaceChildren("Not recording", ...(session ? [
      ". Last: ", el("a", { href: `/sessions/${encodeURIComponent(session.id)}`, text: session.name || session.id }),
      ` ${duration(session.duration_s)}, ${stateText(session)[0]}`,
    ] : []));
  }
}
