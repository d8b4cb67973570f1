// One session as a row of the list: what it is, what has become of it, and what can be done with it.

import * as api from "../common/api.js";
import { frames } from "../common/losses.js";
import { bytes, duration, el, localTime } from "../common/text.js";
import { plainState } from "./state.js";

const HEADS = ["Name", "Node", "Started", "Duration", "Frames", "Marks", "Size", "State", "Download", "Actions"];

/** @param {HTMLInputElement} all chooses every session that is shown */
export function head(all) {
  const row = el("div", { cls: "head", role: "row" }, el("span", { cls: "c-pick", role: "columnheader" }, all));
  for (const text of HEADS) row.append(el("span", { role: "columnheader", text }));
  return row;
}

/** @param {Session} session @param {HTMLInputElement} pick chooses it @param {HTMLElement[]} buttons */
export function makeRow(session, pick, buttons) {
  const [short, long, weight] = plainState(session);
  const name = el("a", {
    cls: "session-name", text: session.name || session.id, "data-part": "open", href: `/sessions/${encodeURIComponent(session.id)}`,
  });
  const about = [session.subject, ...(session.tags ?? []).map((tag) => `#${tag}`), session.notes].filter(Boolean).join(" · ");
  const nameCell = el("div", { cls: "c-name", role: "cell" }, name);
  if (about) nameCell.append(el("span", { cls: "why about", text: about }));
  const state = el("div", { cls: "c-state", role: "cell" }, el("span", { cls: `state ${weight}`, text: short }));
  if (long) state.append(" ", el("span", { cls: "why", text: long }));
  if (session.absolute_scale === "assumed") state.append(" ", el("span", { cls: "why", text: "Scale assumed." }));
  const cell = (cls, label, text) => el("div", { cls, role: "cell", "data-label": label, text });
  const now = counts(session);
  const taken = cell("c-frames", "Frames", null);
  taken.append(el("span", { cls: "taken", text: now.taken }), el("span", { cls: "missed", text: now.missed }));
  return el("div", { cls: "session", role: "row", "data-session-id": session.id, "data-state": session.state, "data-complete": String(session.complete) },
    el("div", { cls: "c-pick", role: "cell" }, pick),
    nameCell,
    cell("c-node", "Node", session.node),
    cell("c-start", "Started", localTime(new Date(session.started_t_ns / 1e6)).slice(0, 16)),
    cell("c-duration", "Duration", now["c-duration"]),
    taken,
    cell("c-marks", "Marks", Number.isFinite(session.marks) ? String(session.marks) : "–"),
    cell("c-size", "Size", bytes(session.bytes)),
    state,
    downloads(session),
    el("div", { cls: "c-do", role: "cell" }, ...buttons));
}

/** What changes while a session grows, by the class of its element. @param {Session} session */
export function counts(session) {
  const lost = Object.values(session.lost ?? {}).reduce((sum, count) => sum + count, 0);
  return {
    "c-duration": duration(session.duration_s),
    taken: Number.isFinite(session.frames) ? session.frames.toLocaleString("en-GB") : "–",
    missed: lost ? `${lost.toLocaleString("en-GB")} missing` : session.pending_frames ? `${frames(session.pending_frames).split(" ")[0]} to come` : "",
  };
}

/** @param {Session} session */
function downloads(session) {
  const box = el("div", { cls: "c-data", role: "cell" });
  for (const [format, text] of [["parquet", "Parquet"], ["arrow", "Arrow"], ["csv", "CSV"]]) {
    if (format === "parquet" && session.state !== "sealed") continue; // it exists only once sealed
    box.append(el("a", {
      href: api.dataAddress(session, format), download: "", text, "data-part": format,
      "aria-label": `Download ${session.name} as ${text}`,
    }));
  }
  return box;
}
