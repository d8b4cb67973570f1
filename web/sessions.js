// The list of sessions: newest first, kept up to date by the link, more on request.

import * as api from "./api.js";
import { notice } from "./notices.js";
import { byId, bytes, duration, el, localTime } from "./text.js";

const MOST = 500; // a page left open for weeks must not grow without end

/** State and completeness in plain words: [short, long, how serious]. */
export function plainState(session) {
  const why = session.problem ? ` ${session.problem}` : "";
  switch (session.state) {
    case "recording": return ["recording", "", "run"];
    case "pending": return ["pending", `Waits for the node to return, then completes by itself.${why}`, "warn"];
    case "sealing": return ["sealing", "Being written; Parquet follows.", "run"];
    case "failed": return ["failed", why.trim() || "The server gave no reason.", "bad"];
    case "sealed":
      if (session.complete === true) return ["complete", why.trim(), "good"];
      if (session.complete === "lossy") return ["lossy", `Frames are missing for good.${why}`, "warn"];
      return ["incomplete", why.trim() || "Not all frames have arrived.", "warn"];
    default: return [String(session.state), why.trim(), "warn"];
  }
}

export class Sessions {
  constructor() {
    this.box = byId("sessions");
    this.sessions = new Map();
    this.rows = new Map();
    this.cursor = null;
    this.editing = null;
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

  draw() {
    const sorted = [...this.sessions.values()].sort((a, b) => b.started_t_ns - a.started_t_ns).slice(0, MOST);
    this.sessions = new Map(sorted.map((session) => [session.id, session]));
    byId("sessions-more").hidden = this.cursor === null || sorted.length >= MOST;
    if (!sorted.length) {
      this.rows.clear();
      this.box.replaceChildren(el("p", { cls: "none", role: "row", text: "No sessions yet. Press Record to start one." }));
      return;
    }
    const rows = new Map();
    for (const session of sorted) {
      const key = JSON.stringify(session);
      const old = this.rows.get(session.id);
      // A row in which a name is being typed, or whose link has the focus, is not torn away.
      const keep = old && (old.key === key || this.editing === session.id);
      rows.set(session.id, keep ? old : { key, row: this.row(session) });
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
    const name = el("span", { cls: "session-name", text: session.name || session.id });
    const rename = el("button", { type: "button", cls: "small", text: "Rename", "data-part": "rename", "aria-label": `Rename ${session.name}` });
    const nameCell = el("div", { cls: "c-name", role: "cell" }, name, rename);
    rename.addEventListener("click", () => this.rename(session, nameCell));
    const state = el("div", { cls: "c-state", role: "cell" }, el("span", { cls: `state ${weight}`, text: short }));
    if (long) state.append(" ", el("span", { cls: "why", text: long }));
    if (session.absolute_scale === "assumed") state.append(" ", el("span", { cls: "why", text: "Scale assumed." }));
    const cell = (cls, label, text) => el("div", { cls, role: "cell", "data-label": label, text });
    return el("article", { cls: "session", role: "row", "data-session-id": session.id, "data-state": session.state, "data-complete": String(session.complete) },
      nameCell,
      cell("c-start", "Started", localTime(new Date(session.started_t_ns / 1e6))),
      cell("c-duration", "Duration", duration(session.duration_s)),
      cell("c-frames", "Frames", Number.isFinite(session.frames) ? session.frames.toLocaleString("en-GB") : "–"),
      cell("c-size", "Size", bytes(session.bytes)),
      state,
      downloads(session));
  }

  rename(session, cell) {
    this.editing = session.id;
    const field = el("input", { type: "text", maxlength: "200", "aria-label": "New name; Enter saves, Escape cancels" });
    field.value = session.name;
    const old = [...cell.childNodes];
    cell.replaceChildren(field);
    field.focus();
    field.select();
    let done = false;
    const finish = async (save, byKey) => {
      if (done) return;
      done = true;
      const name = field.value.trim();
      if (save && name && name !== session.name) {
        try {
          this.sessions.set(session.id, await api.renameSession(session.id, name) ?? { ...session, name });
        } catch (error) {
          notice(error.message, { bad: true });
        }
      }
      cell.replaceChildren(...old);
      this.editing = null;
      this.draw();
      if (byKey) this.rows.get(session.id)?.row.querySelector('[data-part="rename"]')?.focus();
    };
    field.addEventListener("keydown", (event) => {
      if (event.key === "Enter" && !event.isComposing) finish(true, true);
      if (event.key === "Escape") finish(false, true);
    });
    field.addEventListener("blur", () => finish(true));
  }
}

function head() {
  const row = el("div", { cls: "head", role: "row" });
  for (const text of ["Name", "Started", "Duration", "Frames", "Size", "State", "Download"]) row.append(el("span", { role: "columnheader", text }));
  return row;
}

function downloads(session) {
  const box = el("div", { cls: "c-data", role: "cell" });
  for (const [format, text] of [["parquet", "Parquet"], ["arrow", "Arrow"], ["csv", "CSV"]]) {
    if (format === "parquet" && session.state !== "sealed") continue; // it exists only once sealed
    box.append(el("a", {
      href: api.dataAddress(session.id, format), download: "", text, "data-part": format,
      "aria-label": `Download ${session.name} as ${text}`,
    }));
  }
  return box;
}
