// The newest session of the chosen node while none is recorded: a link to it, and its state.

import * as api from "../common/api.js";
import { unlessRefused } from "../common/request.js";
import { byId, duration, el } from "../common/text.js";
import { plainState } from "../sessions/state.js";

export class LastSession {
  constructor() {
    this.box = byId("last-session");
    this.key = null;
    this.clear();
  }

  clear() {
    /** @type {Map<string, Session | null>} by node; null: it has none, or the answer is on its way */
    this.newest = new Map();
  }

  /** @param {Session} session */
  take(session) {
    const known = this.newest.get(session.node);
    if (known && known.id !== session.id && known.started_t_ns > session.started_t_ns) return;
    if (known?.id === session.id && known.state === "sealed" && session.state !== "sealed") return; // an answer that the link has overtaken
    this.newest.set(session.node, session);
  }

  /** A session was deleted: its node is asked for again. @param {string} id */
  drop(id) {
    for (const [node, session] of this.newest) if (session?.id === id) this.newest.delete(node);
  }

  async load(node) {
    this.newest.set(node, null);
    const answer = await unlessRefused(api.listSessions({ limit: 1, node })); // the page shows that the server is away
    answer?.items.forEach((session) => this.take(session));
  }

  draw(node) {
    if (node && !this.newest.has(node.node)) this.load(node.node);
    const session = this.newest.get(node?.node) ?? null;
    const key = JSON.stringify(session);
    if (key === this.key) return;
    this.key = key;
    this.box.replaceChildren("Not recording", ...(session ? [
      ". Last: ", el("a", { href: `/sessions/${encodeURIComponent(session.id)}`, text: session.name || session.id }),
      ` ${duration(session.duration_s)}, ${plainState(session)[0]}`,
    ] : []));
  }
}
