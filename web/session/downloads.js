// Downloads of the session, the visible range or a stance, in every format of the server; optionally of the whole take.

import * as api from "../common/api.js";
import { notice, quietly } from "../common/notices.js";
import { unlessRefused } from "../common/request.js";
import { byId, el, setText } from "../common/text.js";
import { offsetAt } from "./clock.js";
import { timeText } from "./overlay.js";
import { moveClock } from "./time_axis.js";

const EDGE_S = 1e-6; // includes first and last frame of a stance
const BINS_MIN = 50; // of a request for a begin
const BUILT_IN = ["parquet", "arrow", "csv"]; // links on the page; other formats are in a list

/** Download links. */
export class Downloads {
  constructor() {
    this.formats = [];
    this.range = byId("download-range", HTMLSelectElement);
    this.selected = "view"; // preferred range
    this.wholeTake = byId("download-together", HTMLInputElement);
    this.takeOffsetS = 0; // this session's first frame after the take's, by the server's clock
    this.mayEnd = el("input", { type: "checkbox", id: "download-may-end" });
    this.links = new Map(BUILT_IN.map((name) => [name, byId(`download-${name}`, HTMLAnchorElement)]));
  }

  /** Load the formats of the server. `changed()` runs after a change of the selection. */
  async load(session, changed) {
    this.wholeTake.addEventListener("change", () => quietly(async () => {
      if (this.wholeTake.checked) this.takeOffsetS = await takeOffset(session);
      changed();
    }));
    this.mayEnd.addEventListener("change", changed);
    this.range.addEventListener("change", () => { this.selected = this.range.value; changed(); });
    this.formats = (await api.listFormats()).items;
    const others = this.formats.filter((format) => !BUILT_IN.includes(format.name));
    byId("download-list").replaceChildren(...others.map((format) => this.item(format)));
    byId("downloads-more").hidden = !others.length;
    if (session.take) await this.offerTake(session);
  }

  async offerTake(session) {
    const beside = (await api.getTake(session.take)).sessions.filter((other) => other.id !== session.id);
    byId("download-take").hidden = !beside.length;
    setText(byId("download-take-text"), `whole take in one file (with ${beside.map((other) => other.node).join(", ")}), by the server's clock`);
  }

  item(format) {
    if (format.missing) {
      return el("li", {}, el("span", { text: format.title }),
        el("span", { cls: "soft", text: `not installed on the server: pip install 'foottile[${format.missing}]'` }));
    }
    const link = el("a", { id: `download-${format.name}`, download: "", text: format.title });
    this.links.set(format.name, link);
    const item = el("li", { "data-format": format.name }, link, el("span", { cls: "soft", text: format.opened_by }));
    if (!format.options.includes("long_gap")) return item;
    link.addEventListener("click", (event) => {
      event.preventDefault();
      quietly(() => this.download(link));
    });
    item.append(el("label", { cls: "soft", title: "Else a file with a gap of the force that is too long to fill is refused" },
      this.mayEnd, " may end before a long gap"));
    return item;
  }

  /** Download a file that may be refused, or have gaps that were filled; say so. @param {HTMLAnchorElement} link */
  async download(link) {
    const remarks = await api.checkDownload(link.href);
    if (remarks) notice(remarks, { stays: true });
    el("a", { href: link.href, download: "" }).click();
  }

  /** Show the formats that this session has. */
  offer(whole) {
    this.links.get("parquet").hidden = whole.provisional;
    for (const format of this.formats) {
      const item = this.links.get(format.name)?.closest("li");
      const isUnavailable = this.wholeTake.checked ? !format.can_hold_several_sessions || whole.provisional : format.needs_sealed && whole.provisional;
      if (item) item.hidden = isUnavailable || (format.needs_forces && !whole.estimated);
    }
  }

  /** Select the current stance. */
  selectStance() {
    this.selected = "stance";
    this.range.scrollIntoView({ block: "center" });
    this.range.focus();
  }

  /**
   * Update the links to the selected range.
   * @param {SessionView} session @param {import("./view.js").View} view @param {boolean} all the view is the whole session
   * @param {{number: number, from: number, to: number} | undefined} stance selected
   */
  draw(session, view, all, stance) {
    const between = ({ from, to }) => `${timeText(from, 0.01)} to ${timeText(to, 0.01)}`;
    const options = new Map([["all", "whole session"]]);
    if (!all) options.set("view", `visible range: ${between(view)}`);
    if (stance) options.set("stance", `stance ${stance.number}: ${between(stance)}`);
    const key = [...options.values()].join("|");
    if (this.range.dataset.key !== key) {
      this.range.dataset.key = key;
      this.range.replaceChildren(...[...options].map(([value, text]) => el("option", { value, text })));
    }
    const chosen = [this.selected, "view", "all"].find((value) => options.has(value));
    this.range.value = chosen;
    const { from, to } = chosen === "stance" ? { from: Math.max(0, stance.from - EDGE_S), to: stance.to + EDGE_S } : view;
    for (const [name, link] of this.links) {
      const ofTake = this.wholeTake.checked && !BUILT_IN.includes(name);
      const laterS = ofTake ? this.takeOffsetS : 0;
      const part = chosen === "all" ? "" : `&start_s=${(from + laterS).toFixed(6)}&end_s=${(to + laterS).toFixed(6)}`;
      const option = this.mayEnd.checked && this.has(name, "long_gap") ? "&long_gap=end" : "";
      link.href = (ofTake ? api.takeDataAddress(session.take, name, part) : api.dataAddress(session, name, part)) + option;
    }
  }

  has(name, option) { return this.formats.some((format) => format.name === name && format.options.includes(option)); }
}

/** Return a session's first frame after the first of its take, by the server's clock, in s. @param {SessionView} session */
async function takeOffset(session) {
  const begins = await Promise.all((await api.getTake(session.take)).sessions.map(async ({ id, parts }) => {
    const [clock, { begin_t_ns: beginNs, time_axis: axis }] = await Promise.all([
      unlessRefused(api.clockOf(id)), api.overview(id, { points: BINS_MIN }),
    ]);
    const offset = clock && offsetAt(moveClock(axis, parts, clock), beginNs, false);
    return { id, at: offset === null ? Infinity : beginNs + offset }; // a file of a take without the server's clock is refused
  }));
  const offsetS = (begins.find(({ id }) => id === session.id).at - Math.min(...begins.map(({ at }) => at))) * 1e-9;
  return Number.isFinite(offsetS) ? offsetS : 0;
}
