// Downloads of what is in view, in every format that the server lists.

import * as api from "../common/api.js";
import { byId, el, setText } from "../common/text.js";

const AT_ONCE = ["parquet", "arrow", "csv"]; // they stand in the page; the others are in a list

export class Downloads {
  constructor() {
    this.formats = [];
    this.links = new Map(AT_ONCE.map((name) => [name, byId(`download-${name}`, HTMLAnchorElement)]));
  }

  /** What the server can make; without an answer there are those in the page. */
  async load() {
    this.formats = (await api.listFormats()).items;
    const others = this.formats.filter((format) => !AT_ONCE.includes(format.name));
    byId("download-list").replaceChildren(...others.map((format) => this.item(format)));
    byId("downloads-more").hidden = !others.length;
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
      if (item) item.hidden = (format.needs_sealed && whole.provisional) || (format.needs_forces && !whole.estimated);
    }
  }

  /** Leads to what is in view. */
  draw(session, view, all) {
    const part = all ? "" : `&start_s=${view.from.toFixed(6)}&end_s=${view.to.toFixed(6)}`;
    setText(byId("download-what"), all ? "Download" : "Download what is in view");
    for (const [name, link] of this.links) link.href = api.dataAddress(session, name, part);
  }
}
