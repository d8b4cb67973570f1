// The list of sessions: newest first or as searched for, those of a take together, more as one scrolls.

import * as api from "../common/api.js";
import { ask, edit } from "../common/dialogs.js";
import { frames } from "../common/losses.js";
import { mayPress } from "../common/login.js";
import { menuButton } from "../common/menu.js";
import { notice, quietly } from "../common/notices.js";
import { byId, el, setData, setText } from "../common/text.js";
import { Chosen } from "./chosen.js";
import { counts, head, makeRow, makeTakeRow } from "./row.js";
import { plainState } from "./state.js";

const MOST = 5000; // a page left open for weeks must not grow without end
const [FIRST, MORE] = [20, 100]; // in an answer
const AHEAD_PX = 800; // of the end of the list the next are asked for
const TYPING_MS = 200;
const COMPARED_MOST = 6; // in a menu

export class Sessions {
  /** `onSession(session)` takes what an answer brings, `onDeleted(id)` what was moved to the trash. */
  constructor({ onSession, onDeleted }) {
    this.onSession = onSession;
    this.onDeleted = onDeleted;
    this.box = byId("sessions");
    this.more = byId("sessions-more");
    this.sessions = new Map();
    this.rows = new Map();
    this.keys = new WeakMap(); // session -> all that is said of it, to tell what changed
    this.cursor = null;
    this.asked = 0;
    this.since = null; // what was told of sessions while the newest are asked for: id -> session or null
    /** @type {{q?: string, complete?: string}} */
    this.wanted = {}; // as the server is asked
    this.takeRows = new Map(); // id of a take -> its row and what it shows
    this.all = el("input", { type: "checkbox", "aria-label": "Select all that are listed" });
    this.head = head(this.all);
    this.chosen = new Chosen({ all: this.all, onSession, onDeleted, shown: () => [...this.sessions.values()] });
    this.more.addEventListener("click", () => this.load(this.cursor));
    new IntersectionObserver(([one]) => { if (one.isIntersecting) this.load(this.cursor); }, { rootMargin: `${AHEAD_PX}px` }).observe(this.more);
    const field = byId("sessions-search", HTMLInputElement);
    let typing = null;
    field.addEventListener("input", () => {
      clearTimeout(typing);
      typing = setTimeout(() => this.want("q", field.value.trim()), TYPING_MS);
    });
    const whole = byId("sessions-complete", HTMLSelectElement);
    whole.addEventListener("change", () => this.want("complete", whole.value));
    const asked = new URLSearchParams(location.search);
    field.value = asked.get("q")?.trim() ?? "";
    whole.value = asked.get("complete") ?? "";
    if (whole.selectedIndex < 0) whole.value = "";
    for (const [what, value] of [["q", field.value], ["complete", whole.value]]) if (value) this.wanted[what] = value;
  }

  /** List only what has this; with an empty value whatever it is. */
  want(what, value) {
    if (value === (this.wanted[what] ?? "")) return;
    if (value) this.wanted[what] = value;
    else delete this.wanted[what];
    const query = String(new URLSearchParams(this.wanted));
    history.replaceState(null, "", location.pathname + (query ? `?${query}` : ""));
    this.reload();
  }

  /** Load the newest page, or the one at `cursor`. Quiet: the link already says if the server is gone. */
  async load(cursor = null) {
    if (cursor && this.loading === cursor) return [];
    this.loading = cursor;
    const number = cursor ? this.asked : ++this.asked;
    const since = cursor ? this.since : this.since = new Map();
    let page;
    try {
      page = await api.listSessions({ limit: cursor ? MORE : FIRST, ...(cursor ? { cursor } : {}), ...this.wanted });
    } catch (error) {
      if (!(error instanceof api.Refusal)) throw error;
      if (cursor) notice(error.message, { bad: true });
      return [];
    } finally {
      if (this.loading === cursor) this.loading = null;
    }
    if (number !== this.asked) return []; // something else was searched for meanwhile
    const items = page?.items ?? [];
    if (!cursor) {
      this.sessions.clear();
      this.since = null;
    }
    for (const session of items) this.sessions.set(session.id, session);
    for (const [id, session] of since ?? []) {
      if (session) this.sessions.set(id, session);
      else this.sessions.delete(id);
    }
    this.cursor = page?.next_cursor ?? null;
    this.draw();
    return items;
  }

  /** After a reconnection: the server may be another one, with other sessions. */
  reload() {
    return this.load();
  }

  /** @param {Session} session */
  take(session) {
    if (!isWanted(session, this.wanted)) return this.drop(session.id);
    // An answer that the link has overtaken: what is sealed stays sealed.
    if (this.sessions.get(session.id)?.state === "sealed" && session.state !== "sealed") return null;
    this.since?.set(session.id, session);
    this.sessions.set(session.id, session);
    return this.draw();
  }

  /** How far an unsealed session has come: in its place, so that its buttons stay as they are. */
  count(id, counted) {
    const session = this.sessions.get(id);
    if (!session) return;
    const now = { ...session, ...counted };
    const shown = this.rows.get(id);
    if (plainState(now)[1] !== plainState(session)[1] || !shown) return this.take(now);
    this.sessions.set(id, now);
    shown.key = this.keyOf(now);
    for (const [cls, text] of Object.entries(counts(now))) setText(shown.row.querySelector(`.${cls}`), text);
  }

  drop(id) {
    this.since?.set(id, null);
    if (this.sessions.delete(id)) this.draw();
  }

  /** @param {Session} session */
  keyOf(session) {
    let key = this.keys.get(session);
    if (key === undefined) this.keys.set(session, key = JSON.stringify(session));
    return key;
  }

  draw() {
    const sorted = [...this.sessions.values()].sort((a, b) => b.started_t_ns - a.started_t_ns).slice(0, MOST);
    this.sessions = new Map(sorted.map((session) => [session.id, session]));
    this.more.hidden = this.cursor === null || sorted.length >= MOST;
    if (!sorted.length) {
      this.rows.clear();
      this.box.setAttribute("role", "group"); // a table has rows
      this.box.replaceChildren(el("p", { cls: "none", text: none(this.wanted) }));
      this.chosen.draw();
      return;
    }
    this.box.setAttribute("role", "table");
    const rows = new Map();
    const lines = [this.head];
    const takeRows = new Map();
    for (const group of grouped(sorted)) {
      if (group.length > 1) lines.push(this.takeRow(group, takeRows));
      const nodes = group.map(({ node }) => node).join(" "); // its menu names them
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

  /** The row above the sessions of a take, the one that is there if it shows the same. */
  takeRow(group, takeRows) {
    const { take } = group[0];
    const key = JSON.stringify(group.map(({ id, name, node }) => [id, name, node]));
    const old = this.takeRows.get(take);
    const shown = old?.key === key ? old : { key, row: makeTakeRow(group, this.chosen.pickAll(group)) };
    takeRows.set(take, shown);
    return shown.row;
  }

  /** Only what is new or gone is touched: a thousand rows are not laid out again for one. */
  place(wanted) {
    const kept = new Set(wanted);
    for (const old of [...this.box.children]) if (!kept.has(old)) old.remove();
    wanted.forEach((row, i) => { if (this.box.children[i] !== row) this.box.insertBefore(row, this.box.children[i] ?? null); });
  }

  /** What can be done with a session in its present state. @param {Session} session */
  menu(session) {
    return menuButton(`Actions: ${session.name || session.id}`, () => {
      const now = this.sessions.get(session.id) ?? session;
      return [...links(now, this.others(now)), ...(mayPress() ? this.buttons(now) : [])];
    });
  }

  /** The other sessions of its take that are listed. @param {Session} session */
  others({ id, take }) {
    return take ? [...this.sessions.values()].filter((other) => other.take === take && other.id !== id) : [];
  }

  /** @param {Session} session */
  buttons(session) {
    const made = [];
    const add = (part, text, action) => {
      const button = el("button", { type: "button", text, "data-part": part });
      button.addEventListener("click", () => quietly(() => action(this.sessions.get(session.id) ?? session)));
      made.push(button);
    };
    add("edit", "Edit …", (now) => this.edit(now));
    if (session.state === "pending") add("seal", session.waits_for === "end" ? "Seal as it is …" : "Seal without them …", (now) => this.seal(now));
    if (session.state === "sealed" || session.state === "pending") add("delete", "Delete", (now) => this.delete(now));
    return made;
  }

  /** @param {Session} session */
  async edit(session) {
    const changes = await edit(session);
    if (changes) this.onSession(await api.changeSession(session.id, changes));
  }

  /** @param {Session} session */
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

  /** @param {Session} session */
  async delete(session) {
    await api.deleteSession(session.id);
    this.onDeleted(session.id);
    notice(`“${session.name}” is in the trash.`, {
      press: ["Undo", () => quietly(async () => this.onSession(await api.restoreSession(session.id)))],
    });
  }
}

/** Downloads, and comparisons with the others of its take. @param {Session} session @param {Session[]} others */
function links(session, others) {
  const link = (part, text, attributes) => el("a", { text, "data-part": part, ...attributes });
  const formats = [["parquet", "Parquet"], ["arrow", "Arrow"], ["csv", "CSV"]]
    .filter(([format]) => format !== "parquet" || session.state === "sealed"); // it exists only once sealed
  return [
    ...formats.map(([format, text]) => link(format, `Download ${text}`, { href: api.dataAddress(session, format), download: "" })),
    ...others.filter(({ state }) => state === "sealed" && session.state === "sealed").slice(0, COMPARED_MOST)
      .map((other) => link("compare", `Compare with ${other.node}`, { href: `/sessions/${encodeURIComponent(session.id)}?with=${encodeURIComponent(other.id)}` })),
  ];
}

/** Sessions that are newest first, those of a take together and in the order of their nodes. @param {Session[]} sessions */
function grouped(sessions) {
  const groups = new Map();
  for (const session of sessions) {
    const key = session.take ?? session.id;
    if (groups.has(key)) groups.get(key).push(session);
    else groups.set(key, [session]);
  }
  const byNode = (a, b) => a.node.localeCompare(b.node, "en", { numeric: true });
  return [...groups.values()].map((group) => group.sort(byNode));
}

const MISSING = { true: "complete", lossy: "lacking frames", false: "incomplete" };

/** @param {{q?: string, complete?: string}} wanted */
function none({ q, complete }) {
  if (q) return `No session${complete ? ` that is ${MISSING[complete]}` : ""} mentions “${q}”.`;
  return complete ? `No session is ${MISSING[complete]}.` : "No sessions yet. Press Record on the live page to start one.";
}

/** As the server chooses. @param {Session} session @param {{q?: string, complete?: string}} wanted */
function isWanted(session, { q, complete }) {
  return (!complete || String(session.complete) === complete) && (!q || mentions(session, q.toLowerCase()));
}

function mentions(session, q) {
  const said = [session.id, session.name, session.subject, session.notes, session.node, session.scene, ...(session.tags ?? [])];
  return said.some((text) => text?.toLowerCase().includes(q));
}
