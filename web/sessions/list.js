// The list of sessions: newest first, kept up to date by the link, more on request.

import * as api from "../common/api.js";
import { ask, edit } from "../common/dialogs.js";
import { frames } from "../common/losses.js";
import { notice, quietly } from "../common/notices.js";
import { byId, bytes, duration, el, localTime, setText } from "../common/text.js";
import { plainState } from "./state.js";

const MOST = 500; // a page left open for weeks must not grow without end

export class Sessions {
  /** `onSession(session)` takes what an answer brings, `onDeleted(id)` what was moved to the trash. */
  constructor({ onSession, onDeleted }) {
    this.onSession = onSession;
    this.onDeleted = onDeleted;
    this.box = byId("sessions");
    this.sessions = new Map();
    this.rows = new Map();
    this.cursor = null;
    byId("sessions-more").addEventListener("click", () => this.load(this.cursor));
  }

  /** Load the newest page, or the one at `cursor`. Quiet: the link already says if the server is gone. */
  async load(cursor = null) {
    let page;
    try {
      page = await api.listSessions(cursor);
    } catch (error) {
      if (cursor) notice(error.message, { bad: true });
      return [];
    }
    const items = page?.items ?? [];
    for (const session of items) this.sessions.set(session.id, session);
    if (cursor || this.cursor === null) this.cursor = page?.next_cursor ?? null;
    this.draw();
    return items;
  }

  /** After a reconnection: the server may be another one, with other sessions. */
  reload() {
    this.sessions.clear();
    this.cursor = null;
    return this.load();
  }

  take(session) {
    this.sessions.set(session.id, session);
    this.draw();
  }

  /** How far an unsealed session has come: in its place, so that its buttons stay as they are. */
  count(id, counted) {
    const session = this.sessions.get(id);
    if (!session) return;
    const now = { ...session, ...counted };
    const shown = this.rows.get(id);
    if (plainState(now)[1] !== plainState(session)[1] || !shown) return this.take(now);
    this.sessions.set(id, now);
    shown.key = JSON.stringify(now);
    for (const [cls, text] of Object.entries(counts(now))) setText(shown.row.querySelector(`.${cls}`), text);
  }

  drop(id) {
    this.sessions.delete(id);
    this.draw();
  }

  draw() {
    const sorted = [...this.sessions.values()].sort((a, b) => b.started_t_ns - a.started_t_ns).slice(0, MOST);
    this.sessions = new Map(sorted.map((session) => [session.id, session]));
    byId("sessions-more").hidden = this.cursor === null || sorted.length >= MOST;
    if (!sorted.length) {
      this.rows.clear();
      this.box.setAttribute("role", "group"); // a table has rows
      this.box.replaceChildren(el("p", { cls: "none", text: "No sessions yet. Press Record to start one." }));
      return;
    }
    this.box.setAttribute("role", "table");
    const rows = new Map();
    for (const session of sorted) {
      const key = JSON.stringify(session);
      const old = this.rows.get(session.id);
      rows.set(session.id, old?.key === key ? old : { key, row: this.row(session) });
    }
    this.rows = rows;
    const wanted = [head(), ...[...rows.values()].map(({ row }) => row)];
    wanted[0] = this.box.querySelector(".head") ?? wanted[0];
    if (wanted.length !== this.box.children.length || wanted.some((row, i) => row !== this.box.children[i])) {
      const focused = document.activeElement;
      const inside = this.box.contains(focused) ? [focused.closest("[data-session-id]")?.dataset.sessionId, focused.dataset.part] : null;
      this.box.replaceChildren(...wanted);
      if (inside?.[0]) rows.get(inside[0])?.row.querySelector(`[data-part="${inside[1]}"]`)?.focus();
    }
  }

  row(session) {
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
    return el("div", { cls: "session", role: "row", "data-session-id": session.id, "data-state": session.state, "data-complete": String(session.complete) },
      nameCell,
      cell("c-start", "Started", localTime(new Date(session.started_t_ns / 1e6))),
      cell("c-duration", "Duration", counts(session)["c-duration"]),
      cell("c-frames", "Frames", counts(session)["c-frames"]),
      cell("c-marks", "Marks", Number.isFinite(session.marks) ? String(session.marks) : "–"),
      cell("c-size", "Size", bytes(session.bytes)),
      state,
      downloads(session),
      this.buttons(session));
  }

  /** What can be done with a session in its present state. */
  buttons(session) {
    const box = el("div", { cls: "c-do", role: "cell" });
    const add = (part, text, action) => {
      // Its name begins with what is seen: who speaks to the page says that.
      const button = el("button", { type: "button", cls: "small", text, "data-part": part, "aria-label": `${text}: ${session.name}` });
      button.addEventListener("click", () => quietly(() => action(this.sessions.get(session.id) ?? session)));
      box.append(button);
    };
    add("edit", "Edit", (now) => this.edit(now));
    if (session.state === "pending") add("seal", session.waits_for === "end" ? "Seal as it is" : "Seal without them", (now) => this.seal(now));
    if (session.state === "sealed" || session.state === "pending") add("delete", "Delete", (now) => this.delete(now));
    return box;
  }

  async edit(session) {
    const changes = await edit(session);
    if (changes) this.onSession(await api.changeSession(session.id, changes));
  }

  async seal(session) {
    const many = frames(session.pending_frames);
    const [question, loss] = session.waits_for === "end"
      ? ["as it is", "What the node may have taken after the last frame that came is given up, and"]
      : ["without them", `${many[0].toUpperCase()}${many.slice(1)} will be missing for good, and`];
    const sure = await ask(`Seal “${session.name}” ${question}?`,
      `${loss} the session is marked lossy. Do this only if the node never comes back: while you wait, it completes by itself as soon as the node does.`,
      "Seal as lossy");
    if (!sure) return;
    this.onSession(await api.sealSession(session.id));
    notice(`Sealed “${session.name}” ${question}.`);
  }

  async delete(session) {
    await api.deleteSession(session.id);
    this.onDeleted(session.id);
    notice(`“${session.name}” is in the trash.`, {
      undo: () => quietly(async () => this.onSession(await api.restoreSession(session.id))),
    });
  }
}

/** What changes while a session grows, by the class of its cell. */
function counts(session) {
  return {
    "c-duration": duration(session.duration_s),
    "c-frames": Number.isFinite(session.frames) ? session.frames.toLocaleString("en-GB") : "–",
  };
}

function head() {
  const row = el("div", { cls: "head", role: "row" });
  for (const text of ["Name", "Started", "Duration", "Frames", "Marks", "Size", "State", "Download", "Actions"]) row.append(el("span", { role: "columnheader", text }));
  return row;
}

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
