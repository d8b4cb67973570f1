// List of sessions: newest first, filtered, grouped by take, loaded while scrolling.

import * as api from "../common/api.js";
import { ask, edit } from "../common/dialogs.js";
import { frames, greatestShare, percentText } from "../common/losses.js";
import { isOperator } from "../common/login.js";
import { menuButton } from "../common/menu.js";
import { notice, quietly } from "../common/notices.js";
import { unlessRefused } from "../common/request.js";
import { byId, el, setData, setText } from "../common/text.js";
import { Chosen } from "./chosen.js";
import { comparisonAddress, counts, head, makeRow, makeTakeRow } from "./row.js";
import { stateText } from "./state.js";

const SESSIONS_MAX = 5000; // bounds a page left open for weeks
const [FIRST, MORE] = [20, 100]; // sessions per response
const AHEAD_PX = 800; // before the end of the list the next are requested
const TYPING_MS = 200;
const COMPARED_MAX = 6; // in a menu

/** List of sessions. */
export class Sessions {
  /** `onSession(session)` receives sessions of responses, `onDeleted(id)` those moved to the trash. */
  constructor({ onSession, onDeleted }) {
    this.onSession = onSession;
    this.onDeleted = onDeleted;
    this.box = byId("sessions");
    this.more = byId("sessions-more");
    this.sessions = new Map();
    this.rows = new Map();
    this.keys = new WeakMap(); // session -> its JSON, to detect changes
    this.cursor = null;
    this.requests = 0;
    this.since = null; // updates during a request: id -> session or null
    /** @type {{q?: string, complete?: string}} */
    this.filter = {}; // query of the server
    this.takeRows = new Map(); // take id -> row and key
    this.trashed = 0; // sessions in the trash
    this.all = el("input", { type: "checkbox", "aria-label": "Select all" });
    this.head = head(this.all);
    this.chosen = new Chosen({ all: this.all, onSession, onDeleted, shown: () => [...this.sessions.values()] });
    this.more.addEventListener("click", () => this.load(this.cursor));
    new IntersectionObserver(([one]) => { if (one.isIntersecting) this.load(this.cursor); }, { rootMargin: `${AHEAD_PX}px` }).observe(this.more);
    const field = byId("sessions-search", HTMLInputElement);
    let typing = null;
    field.addEventListener("input", () => {
      clearTimeout(typing);
      typing = setTimeout(() => this.setFilter("q", field.value.trim()), TYPING_MS);
    });
    const whole = byId("sessions-complete", HTMLSelectElement);
    whole.addEventListener("change", () => this.setFilter("complete", whole.value));
    const asked = new URLSearchParams(location.search);
    field.value = asked.get("q")?.trim() ?? "";
    whole.value = asked.get("complete") ?? "";
    if (whole.selectedIndex < 0) whole.value = "";
    for (const [what, value] of [["q", field.value], ["complete", whole.value]]) if (value) this.filter[what] = value;
  }

  /** Filter the list; an empty value removes the filter. */
  setFilter(name, value) {
    if (value === (this.filter[name] ?? "")) return;
    if (value) this.filter[name] = value;
    else delete this.filter[name];
    const query = String(new URLSearchParams(this.filter));
    history.replaceState(null, "", location.pathname + (query ? `?${query}` : ""));
    this.load();
  }

  /** Load the first page, or the one at `cursor`. Silent if the server is down: the link shows that. */
  async load(cursor = null) {
    if (cursor && this.loading === cursor) return [];
    this.loading = cursor;
    const number = cursor ? this.requests : ++this.requests;
    const since = cursor ? this.since : this.since = new Map();
    const page = await unlessRefused(api.listSessions({ limit: cursor ? MORE : FIRST, ...(cursor ? { cursor } : {}), ...this.filter }),
      ({ message }) => { if (cursor) notice(message, { bad: true }); })
      .finally(() => { if (this.loading === cursor) this.loading = null; });
    if (!page || number !== this.requests) return []; // the filter has changed
    const { items } = page;
    if (!cursor) {
      this.sessions.clear();
      this.since = null;
    }
    for (const session of items) this.sessions.set(session.id, session);
    for (const [id, session] of since ?? []) {
      if (session) this.sessions.set(id, session);
      else this.sessions.delete(id);
    }
    this.cursor = page.next_cursor ?? null;
    this.draw();
    return items;
  }

  /** Add or replace a session. @param {SessionView} session */
  update(session) {
    if (!isIncluded(session, this.filter)) return this.drop(session.id);
    // Outdated response: a sealed session stays sealed.
    if (this.sessions.get(session.id)?.state === "sealed" && session.state !== "sealed") return null;
    this.since?.set(session.id, session);
    this.sessions.set(session.id, session);
    return this.draw();
  }

  /** Update the progress of an unsealed session in place, so that its buttons keep the focus. */
  updateProgress(id, progress) {
    const session = this.sessions.get(id);
    if (!session) return;
    const now = { ...session, ...progress };
    const shown = this.rows.get(id);
    if (String(stateText(now)) !== String(stateText(session)) || !shown) return this.update(now);
    this.sessions.set(id, now);
    shown.key = this.keyOf(now);
    for (const [cls, text] of Object.entries(counts(now))) setText(shown.row.querySelector(`.${cls}`), text);
  }

  drop(id) {
    this.since?.set(id, null);
    if (this.sessions.delete(id)) this.draw();
  }

  /** @param {SessionView} session */
  keyOf(session) {
    let key = this.keys.get(session);
    if (key === undefined) this.keys.set(session, key = JSON.stringify(session));
    return key;
  }

  setTrashCount(count) {
    this.trashed = count;
    if (this.box.querySelector(".none")) this.draw();
  }

  draw() {
    const sorted = [...this.sessions.values()].sort((a, b) => b.started_t_ns - a.started_t_ns).slice(0, SESSIONS_MAX);
    this.sessions = new Map(sorted.map((session) => [session.id, session]));
    this.more.hidden = this.cursor === null || sorted.length >= SESSIONS_MAX;
    if (!sorted.length) {
      this.rows.clear();
      this.box.setAttribute("role", "group"); // a table needs rows
      this.box.replaceChildren(el("p", { cls: "none", text: emptyText(this.filter, this.trashed) }));
      this.chosen.draw();
      return;
    }
    this.box.setAttribute("role", "table");
    const rows = new Map();
    const lines = [this.head];
    const takeRows = new Map();
    for (const group of groupByTake(sorted)) {
      if (group.length > 1) lines.push(this.takeRow(group, takeRows));
      const nodes = group.map(({ node }) => node).join(" "); // shown in the menu
      for (const session of group) {
        const key = this.keyOf(session);
        const old = this.rows.get(session.id);
        const shown = old?.key === key && old.nodes === nodes ? old : { key, nodes, row: makeRow(session, this.chosen.pick(session), this.menu(session)) };
        setData(shown.row, "taken", String(group.length > 1));
        rows.set(session.id, shown);
        lines.push(shown.row);
      }
    }
    const focused = /** @type {HTMLElement | null} */ (document.activeElement);
    const inside = this.box.contains(focused) ? [focused.closest("[data-session-id]")?.getAttribute("data-session-id"), focused.dataset.part] : null;
    this.rows = rows;
    this.takeRows = takeRows;
    this.place(lines);
    this.chosen.draw();
    if (inside?.[0] && !focused.isConnected) rows.get(inside[0])?.row.querySelector(`[data-part="${inside[1]}"]`)?.focus();
  }

  /** Return the row of a take; the old one if unchanged. */
  takeRow(group, takeRows) {
    const { take } = group[0];
    const key = JSON.stringify([percentText(greatestShare(group)), ...group.map(({ id, name, node }) => [id, name, node])]);
    const old = this.takeRows.get(take);
    const shown = old?.key === key ? old : { key, row: makeTakeRow(group, this.chosen.pickAll(group)) };
    takeRows.set(take, shown);
    return shown.row;
  }

  /** Insert and remove changed rows only: no layout of a thousand rows for one. */
  place(lines) {
    const shown = new Set(lines);
    for (const old of [...this.box.children]) if (!shown.has(old)) old.remove();
    lines.forEach((row, i) => { if (this.box.children[i] !== row) this.box.insertBefore(row, this.box.children[i] ?? null); });
  }

  /** Make the menu of a session. @param {SessionView} session */
  menu(session) {
    return menuButton(`Actions: ${session.name || session.id}`, () => {
      const now = this.sessions.get(session.id) ?? session;
      return [...links(now, this.others(now)), ...(isOperator() ? this.buttons(now) : [])];
    });
  }

  /** Return the other listed sessions of its take. @param {SessionView} session */
  others({ id, take }) {
    return take ? [...this.sessions.values()].filter((other) => other.take === take && other.id !== id) : [];
  }

  /** @param {SessionView} session */
  buttons(session) {
    const made = [];
    const add = (part, text, action) => {
      const button = el("button", { type: "button", text, "data-part": part });
      button.addEventListener("click", () => quietly(() => action(this.sessions.get(session.id) ?? session)));
      made.push(button);
    };
    add("edit", "Edit …", (now) => this.edit(now));
    if (session.state === "pending") add("seal", session.pending_reason === "end" ? "Seal now …" : "Abandon missing frames …", (now) => this.abandon(now));
    if (session.state === "sealed" || session.state === "pending") add("delete", "Delete", (now) => this.delete(now));
    return made;
  }

  /** @param {SessionView} session */
  async edit(session) {
    const changes = await edit(session);
    if (changes) this.onSession(await api.changeSession(session.id, changes));
  }

  /** @param {SessionView} session */
  async abandon(session) {
    const many = frames(session.pending_frames);
    const [title, loss] = session.pending_reason === "end"
      ? [`Seal “${session.name}” now?`, "Frames after the last received one are abandoned"]
      : [`Abandon missing frames of “${session.name}”?`, `${many[0].toUpperCase()}${many.slice(1)} will be lost for good`];
    const sure = await ask(title,
      `${loss}, and the session is lossy. Do this only if the node never reconnects: otherwise the session completes once they arrive.`,
      "Seal as lossy");
    if (!sure) return;
    this.onSession(await api.sealSession(session.id));
    notice(`Sealed “${session.name}”.`);
  }

  /** @param {SessionView} session */
  async delete(session) {
    await api.deleteSession(session.id);
    this.onDeleted(session.id);
    notice(`“${session.name}” is in the trash.`, {
      about: [session.id],
      press: ["Undo", () => quietly(async () => this.onSession(await api.restoreSession(session.id)))],
    });
  }
}

/** Return links to downloads and to comparisons within the take. @param {SessionView} session @param {SessionView[]} others */
function links(session, others) {
  const link = (part, text, attributes) => el("a", { text, "data-part": part, ...attributes });
  const formats = [["parquet", "Parquet"], ["arrow", "Arrow"], ["csv", "CSV"]]
    .filter(([format]) => format !== "parquet" || session.state === "sealed"); // only once sealed
  return [
    ...formats.map(([format, text]) => link(format, `Download ${text}`, { href: api.dataAddress(session, format), download: "" })),
    ...others.filter(({ state }) => state === "sealed" && session.state === "sealed").slice(0, COMPARED_MAX)
      .map((other) => link("compare", `Compare with ${other.node}`, { href: comparisonAddress(session, other) })),
  ];
}

/** Group sessions by take, newest first, sorted by node within a take. @param {SessionView[]} sessions */
function groupByTake(sessions) {
  const groups = new Map();
  for (const session of sessions) {
    const key = session.take ?? session.id;
    if (groups.has(key)) groups.get(key).push(session);
    else groups.set(key, [session]);
  }
  const byNode = (a, b) => a.node.localeCompare(b.node, "en", { numeric: true });
  return [...groups.values()].map((group) => group.sort(byNode));
}

const COMPLETENESS = { true: "complete ", lossy: "lossy ", false: "incomplete " };

/** Return the text of an empty list. @param {{q?: string, complete?: string}} filter */
function emptyText({ q, complete }, trashed) {
  const kind = COMPLETENESS[complete] ?? "";
  if (q) return `No ${kind}session matches “${q}”.`;
  if (kind) return `No ${kind}sessions.`;
  return trashed ? `No sessions; ${trashed} in the trash.` : "No sessions yet. Press Record on the live page.";
}

/** Return true if the server would list a session. @param {SessionView} session @param {{q?: string, complete?: string}} filter */
function isIncluded(session, { q, complete }) {
  return (!complete || String(session.complete) === complete) && (!q || matches(session, q.toLowerCase()));
}

function matches(session, q) {
  const texts = [session.id, session.name, session.subject, session.notes, session.node, session.scene, ...(session.tags ?? [])];
  return texts.some((text) => text?.toLowerCase().includes(q));
}
