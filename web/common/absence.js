// Summary of what a page has missed while it slept or had no link.

import * as api from "./api.js";
import { countLost, missedText } from "./losses.js";
import { notice, withdraw } from "./notices.js";
import { unlessRefused } from "./request.js";
import { roughly } from "./text.js";

const LEAST_MS = 5000; // shorter ones are not worth a notice
const LISTED_MAX = 100;
const ABOUT = "absence";

/** Compares what the page knew before a silence with the server's state after it. */
export class Absence {
  constructor() {
    this.heardMs = 0; // date of the latest message; 0: none yet
    this.nodes = new Map(); // name -> latest description and counts
    this.sessions = new Map(); // id -> running recording
  }

  /** Store the state of a message; a hello after a silence is compared with the state before. @param {PageMessage} message */
  watch(message) {
    const nowMs = Date.now();
    const awayMs = this.heardMs ? nowMs - this.heardMs : 0;
    this.heardMs = nowMs;
    if (message.type === "hello") {
      const before = { nodes: this.nodes, sessions: this.sessions };
      this.nodes = new Map(message.nodes.map((node) => [node.node, node]));
      this.sessions = new Map(message.recording.map((session) => [session.id, session]));
      if (awayMs >= LEAST_MS) this.tell(awayMs, before, message.t_ns);
    } else if (message.type === "node") this.nodes.set(message.node.node, message.node);
    else if (message.type === "heartbeat") {
      for (const [name, counts] of Object.entries(message.nodes)) this.nodes.set(name, { ...this.nodes.get(name), ...counts });
    } else if (message.type === "session") {
      if (message.session.state === "recording") this.sessions.set(message.session.id, message.session);
      else this.sessions.delete(message.session.id);
    }
  }

  async tell(awayMs, before, nowTNs) {
    const nodes = [...this.nodes.values()].flatMap((node) => compareNode(before.nodes.get(node.node), node, nowTNs));
    const since = String(BigInt(Math.round(nowTNs)) - BigInt(Math.round(awayMs)) * 1_000_000n);
    const [listed, ...known] = await Promise.all([unlessRefused(api.listSessions({ limit: LISTED_MAX, from: since })),
      ...[...before.sessions.keys()].map((id) => unlessRefused(api.getSession(id)))]);
    const found = new Map([...(listed?.items ?? []), ...known.filter(Boolean)].map((session) => [session.id, session]));
    const parts = [[], [], []];
    let markers = 0;
    for (const session of found.values()) {
      const earlier = before.sessions.get(session.id);
      parts[session.state !== "recording" ? 1 : earlier ? 2 : 0].push(describe(session));
      markers += session.marker_count - (earlier?.marker_count ?? 0);
    }
    const texts = ["Begun", "Ended", "Still running"].flatMap((title, i) => (parts[i].length ? [`${title}: ${parts[i].join(", ")}.`] : []));
    if (markers > 0) texts.push(`${markers} marker${markers === 1 ? "" : "s"} set.`);
    const all = [...nodes, ...texts];
    withdraw(ABOUT);
    notice(`Back after ${roughly(awayMs / 1000)} without data. ${all.join(" ") || (listed ? "Nothing was recorded or lost." : "")}`,
      { stays: all.length > 0, about: [ABOUT] });
  }
}

/** Describe a session's name and end. */
function describe(session) {
  const { name, node, state, complete, lost } = session;
  const count = countLost(lost);
  const end = { recording: "", pending: " pending", sealing: " being sealed", sealed: complete === true ? " complete" : ` lossy (${count.toLocaleString("en-GB")} frames)` }[state];
  return [`“${name}” of ${node}${end}`, missedText(session)].filter(Boolean).join(", ");
}

/** Return sentences about a node that changed; `before` is undefined for a new one. */
function compareNode(before, node, nowTNs) {
  const silentS = node.last_seen_t_ns ? (nowTNs - node.last_seen_t_ns) / 1e9 : null;
  if (!before) return node.connected ? [`Node ${node.node} is new.`] : [];
  if (!node.connected) return before.connected ? [`Node ${node.node} is lost${silentS === null ? "" : `, its last frame came ${roughly(silentS)} ago`}.`] : [];
  if (!before.connected) return [`Node ${node.node} is back.`];
  if (before.stream_id !== node.stream_id) return [`Node ${node.node} was restarted.`];
  const lost = node.lost_frames - before.lost_frames;
  return lost > 0 ? [`Node ${node.node} lost ${lost.toLocaleString("en-GB")} frames.`] : [];
}
