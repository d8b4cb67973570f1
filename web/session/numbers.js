// Visible range as a table.

import * as api from "../common/api.js";
import { unlessRefused } from "../common/request.js";
import { byId, el, setText } from "../common/text.js";
import { Bins } from "./bins.js";
import { flagTexts } from "./flags.js";
import { readingsOf } from "./readout.js";

const POINTS = 12; // rows, at least if there are as many frames
const SETTLED_MS = 400;

/** Table of the visible range. */
export class Numbers {
  constructor(id) {
    this.id = id;
    this.shown = "";
  }

  /** Load the numbers of the view, if the table is open. */
  draw(view, panels) {
    const key = `${view.from} ${view.to}`;
    if (!byId("numbers-card", HTMLDetailsElement).open || key === this.shown) return;
    this.shown = key;
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.load(view, key, panels), SETTLED_MS);
  }

  async load(view, key, panels) {
    const answer = await unlessRefused(api.overview(this.id, { points: POINTS, start_s: view.from, end_s: view.to + 1e-6 }),
      ({ message }) => setText(byId("numbers-problem"), message));
    if (!answer || key !== this.shown) return;
    const bins = new Bins(answer, view);
    const rows = Array.from({ length: bins.count }, (_, i) => ({ readings: readingsOf(bins, i, panels), flags: flagTexts(bins, i).join(", ") }));
    const names = (rows[0]?.readings ?? []).map(([, name]) => name).concat("Notes");
    byId("numbers-head").replaceChildren(...names.map((name) => el("th", { scope: "col", text: name })));
    byId("numbers-rows").replaceChildren(...rows.map(({ readings, flags }) =>
      el("tr", {}, ...readings.map(([, , value]) => el("td", { text: value })), el("td", { text: flags }))));
  }
}
