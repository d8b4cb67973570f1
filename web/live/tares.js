// Tares of a node: time, reason, state. Loaded when opened.

import * as api from "../common/api.js";
import { showRefusal } from "../common/notices.js";
import { byId, el, localTime, number, setText } from "../common/text.js";

const SHOWN = 20;

/** List of tares. */
export class Tares {
  constructor() {
    this.card = byId("tares-card", HTMLDetailsElement);
    this.shown = "";
    this.isOpening = false; // the list is scrolled into view once it is loaded
    this.card.addEventListener("toggle", () => {
      this.shown = "";
      this.isOpening = this.card.open;
    });
  }

  /** Load the list while it is open and outdated; cheap to call. */
  draw(node) {
    this.card.hidden = !node;
    if (!node || !this.card.open) return;
    const key = `${node.node} ${node.tare?.id} ${node.auto_tare}`;
    if (key === this.shown) return;
    this.shown = key;
    this.load(node);
  }

  async load(node) {
    try {
      const { items, drift } = await api.listTares(node.node);
      byId("tares").replaceChildren(...items.slice(0, SHOWN).map((tare) => row(tare, items)));
      setText(byId("tares-legend"), legend(items, drift, node));
      if (this.isOpening) this.card.scrollIntoView({ block: "nearest" }); // below the fold of a laptop
      this.isOpening = false;
    } catch (error) {
      showRefusal(error);
    }
  }
}

function row(tare, items) {
  const isActive = !tare.undone && items.find((other) => !other.undone)?.id === tare.id;
  const state = tare.undone ? ", undone" : isActive ? ", active" : "";
  return el("li", { text: `${localTime(new Date(tare.t_ns / 1e6))} ${tare.reason.replaceAll(" -", " −")}${state}` });
}

function legend(items, drift, { tiles }) {
  const all = `${items.length}, newest first`;
  const known = drift.kpa_per_hour.filter(Number.isFinite);
  if (!known.length) return all;
  const most = known.reduce((a, b) => (Math.abs(b) > Math.abs(a) ? b : a));
  const newtons = Number.isFinite(drift.grf_n_per_hour) ? `, ${number(drift.grf_n_per_hour)} N/h on the foot` : "";
  const tile = tiles[drift.kpa_per_hour.indexOf(most)]; // none: the tiles have changed meanwhile
  return `${all}; drift, a line through the tares of the last 6 h that are not undone: up to ${number(most, 2)} kPa/h${tile ? ` (${tile.serial})` : ""}${newtons}`;
}
