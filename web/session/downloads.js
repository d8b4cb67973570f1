// Downloads of all, of what is in view or of a stance, in every format that the server lists; of a take all its sessions in one file.

import * as api from "../common/api.js";
import { byId, el, setText } from "../common/text.js";
import { timeWords } from "./overlay.js";

const EDGE_S = 1e-6; // so that the first and the last frame of a stance are in it
const AT_ONCE = ["parquet", "arrow", "csv"]; // they stand in the page; the others are in a list

export class Downloads {
  constructor() {
    this.formats = [];
    this.range = byId("download-range", HTMLSelectElement);
    this.wanted = "view"; // what of the session, if there is such
    this.together = byId("download-together", HTMLInputElement);
    this.links = new Map(AT_ONCE.map((name) => [name, byId(`download-${name}`, HTMLAnchorElement)]));
  }

  /** What the server can make; without an answer there are those in the page. `changed`: all of the take, or not. */
  async load(session, changed) {
    this.together.addEventListener("change", changed);
    this.range.addEventListener("change", () => { this.wanted = this.range.value; changed(); });
    this.formats = (await api.listFormats()).items;
    const others = this.formats.filter((format) => !AT_ONCE.includes(format.name));
    byId("download-list").replaceChildren(...others.map((format) => this.item(format)));
    byId("downloads-more").hidden = !others.length;
    if (session.take) await this.offerTake(session);
  }

  async offerTake(session) {
    const beside = (await api.getTake(session.take)).sessions.filter((other) => other.id !== session.id);
    byId("download-take").hidden = !beside.length;
    setText(byId("download-take-text"), `with the others of this take (${beside.map((other) => other.node).join(", ")}), in one file by the server's clock`);
  }

  item(format) {
    if (format.missing) {
      return el("li", {}, el("span", { text: format.title }),
        el("span", { cls: "soft", text: `the server lacks it: pip install 'foottile[${format.missing}]'` }));
    }
    const link = el("a", { id: `download-${format.name}`, download: "", text: format.title });
    this.links.set(format.name, link);
    return el("li", { "data-format": format.name }, link, el("span", { cls: "soft", text: format.opened_by }));
  }

  /** Which there are of this session. */
  offer(whole) {
    this.links.get("parquet").hidden = whole.provisional;
    for (const format of this.formats) {
      const item = this.links.get(format.name)?.closest("li");
      const lacks = this.together.checked ? !format.holds_several || whole.provisional : format.needs_sealed && whole.provisional;
      if (item) item.hidden = lacks || (format.needs_forces && !whole.estimated);
    }
  }

  /** The chosen stance is wanted. */
  wantStance() {
    this.wanted = "stance";
    this.range.scrollIntoView({ block: "center" });
    this.range.focus();
  }

  /**
   * Links lead to what is wanted of the session.
   * @param {Session} session @param {import("./view.js").View} view @param {boolean} all is in view
   * @param {{number: number, from: number, to: number} | undefined} stance that is chosen
   */
  draw(session, view, all, stance) {
    const between = ({ from, to }) => `${timeWords(from, 0.01)} to ${timeWords(to, 0.01)}`;
    const options = new Map([["all", "all of it"]]);
    if (!all) options.set("view", `what is in view: ${between(view)}`);
    if (stance) options.set("stance", `stance ${stance.number}: ${between(stance)}`);
    const key = [...options.values()].join("|");
    if (this.range.dataset.key !== key) {
      this.range.dataset.key = key;
      this.range.replaceChildren(...[...options].map(([value, text]) => el("option", { value, text })));
    }
    const chosen = [this.wanted, "view", "all"].find((value) => options.has(value));
    this.range.value = chosen;
    const { from, to } = chosen === "stance" ? { from: Math.max(0, stance.from - EDGE_S), to: stance.to + EDGE_S } : view;
    const part = chosen === "all" ? "" : `&start_s=${from.toFixed(6)}&end_s=${to.toFixed(6)}`;
    for (const [name, link] of this.links) {
      const ofTake = this.together.checked && !AT_ONCE.includes(name);
      link.href = ofTake ? api.takeDataAddress(session.take, name, part) : api.dataAddress(session, name, part);
    }
  }
}
