// Downloads of what is in view, in every format that the server lists; of a take all its sessions in one file.

import * as api from "../common/api.js";
import { byId, el, setText } from "../common/text.js";

const AT_ONCE = ["parquet", "arrow", "csv"]; // they stand in the page; the others are in a list

export class Downloads {
  constructor() {
    this.formats = [];
    this.together = byId("download-together", HTMLInputElement);
    this.links = new Map(AT_ONCE.map((name) => [name, byId(`download-${name}`, HTMLAnchorElement)]));
  }

  /** What the server can make; without an answer there are those in the page. `changed`: all of the take, or not. */
  async load(session, changed) {
    this.together.addEventListener("change", changed);
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

  /** Leads to what is in view. */
  draw(session, view, all) {
    const part = all ? "" : `&start_s=${view.from.toFixed(6)}&end_s=${view.to.toFixed(6)}`;
    setText(byId("download-what"), all ? "Download" : "Download what is in view");
    for (const [name, link] of this.links) {
      const ofTake = this.together.checked && !AT_ONCE.includes(name);
      link.href = ofTake ? api.takeDataAddress(session.take, name, part) : api.dataAddress(session, name, part);
    }
  }
}
