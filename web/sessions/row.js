// Rows of the list: sessions and takes.

import { countLost, frames, greatestShare, percentText } from "../common/losses.js";
import { bytes, duration, el, localTime } from "../common/text.js";
import { stateText, stateTitle } from "./state.js";

const HEADS = ["Name", "Node", "Started", "Duration", "Frames", "Markers", "Size", "State", "Actions"];

/** Make the head of the table. @param {HTMLInputElement} all selects all sessions */
export function head(all) {
  const row = el("div", { cls: "head", role: "row" }, el("span", { cls: "c-pick", role: "columnheader" }, all));
  for (const text of HEADS) row.append(el("span", { role: "columnheader", text }));
  return row;
}

/** Make the row of a session. @param {SessionView} session @param {HTMLInputElement} pick selects it @param {HTMLElement} menu */
export function makeRow(session, pick, menu) {
  const [short, long, weight] = stateText(session);
  const name = el("a", {
    cls: "session-name", text: session.name || session.id, "data-part": "open", href: `/sessions/${encodeURIComponent(session.id)}`,
  });
  const state = el("div", { cls: "c-state", role: "cell" }, el("span", { cls: `state ${weight}`, text: short, title: stateTitle(session) }));
  if (long) state.append(" ", el("span", { cls: "why", text: long }));
  if (session.absolute_scale === "assumed") state.append(" ", el("span", { cls: "why", text: "Scale assumed." }));
  const cell = (cls, label, text) => el("div", { cls, role: "cell", "data-label": label, text });
  const now = counts(session);
  const framesCell = cell("c-frames", "Frames", null);
  framesCell.append(el("span", { cls: "taken", text: now.taken }), el("span", { cls: "missed", text: now.missed }));
  return el("div", { cls: "session", role: "row", "data-session-id": session.id, "data-state": session.state, "data-complete": String(session.complete) },
    el("div", { cls: "c-pick", role: "cell" }, pick),
    el("div", { cls: "c-name", role: "cell" }, name, ...about(session)),
    cell("c-node", "Node", session.node),
    cell("c-start", "Started", localTime(new Date(session.started_t_ns / 1e6)).slice(0, 16)),
    cell("c-duration", "Duration", now["c-duration"]),
    framesCell,
    cell("c-markers", session.marker_count === 1 ? "Marker" : "Markers", Number.isFinite(session.marker_count) ? String(session.marker_count) : "–"),
    cell("c-size", "Size", bytes(session.bytes)),
    state,
    el("div", { cls: "c-do", role: "cell" }, menu));
}

/** Return subject, tags as links that filter the list, and notes. @param {SessionView} session */
function about({ subject, tags, notes }) {
  const parts = [
    ...(subject ? [el("span", { cls: "subject", text: subject })] : []),
    ...(tags ?? []).map((tag) => el("a", { cls: "tag", text: `#${tag}`, href: `/sessions?${new URLSearchParams({ q: tag })}` })),
  ];
  const lines = parts.length ? [el("span", { cls: "labels" }, ...parts)] : [];
  if (notes) lines.push(el("span", { cls: "why about", text: notes }));
  return lines;
}

/** Return the address of a session's page with another one beside it. @param {SessionView} session @param {SessionView} other */
export const comparisonAddress = (session, other) => `/sessions/${encodeURIComponent(session.id)}?with=${encodeURIComponent(other.id)}`;

/** Make the row above the sessions of a take. @param {SessionView[]} sessions @param {HTMLInputElement} pick selects them all */
export function makeTakeRow(sessions, pick) {
  const names = [...new Set(sessions.map(({ name }) => name))];
  const share = greatestShare(sessions);
  const started = localTime(new Date(Math.min(...sessions.map(({ started_t_ns: t_ns }) => t_ns)) / 1e6)).slice(0, 16);
  return el("div", { cls: "take", role: "row", "data-take": sessions[0].take },
    el("div", { cls: "c-pick", role: "cell" }, pick),
    el("div", { cls: "c-take", role: "cell", "aria-colspan": String(HEADS.length) },
      el("span", { cls: "take-word", text: "Take" }), " ", el("strong", { text: names.join(", ") }),
      el("span", { cls: "why", text: ` ${started}, ${sessions.length} nodes: ${sessions.map(({ node }) => node).join(", ")}` }),
      share ? el("span", { cls: "why take-missed", text: `, up to ${percentText(share)} not sampled` }) : ""));
}

/** Return the texts that change during a recording, by class. @param {SessionView} session */
export function counts(session) {
  const lost = countLost(session.lost);
  return {
    "c-duration": duration(session.duration_s),
    taken: Number.isFinite(session.frames) ? session.frames.toLocaleString("en-GB") : "–",
    missed: lost ? `${lost.toLocaleString("en-GB")} missing` : session.pending_frames ? `${frames(session.pending_frames).split(" ")[0]} pending` : "",
  };
}
