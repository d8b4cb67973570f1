// Overlay on the plots of a session: another session or a reference, on this session's time axis.

import { number, setData } from "../common/text.js";
import { Bins } from "./bins.js";
import { Loader } from "./load.js";
import { drawSeries } from "./series.js";

const NEAR_S = 0.05; // a reading further from the cursor does not belong to it

/** @typedef {import("./view.js").View} View */

/** Data of the overlay. */
export class Beside {
  /**
   * @param {object} how
   * @param {string} how.name for the legend
   * @param {Record<string, [string, string]>} how.columns min and max column by panel
   * @param {(query: import("../common/api.js").OverviewQuery, stop?: AbortSignal) => Promise<OverviewView>} how.ask requests bins, on its own time axis
   * @param {() => void} how.onChange
   * @param {(error: Error) => void} how.onError
   */
  constructor({ name, columns, ask, onChange, onError }) {
    this.name = name;
    this.columns = columns;
    this.ask = ask;
    this.shiftS = 0; // this session's time minus its own
    this.aligned = ""; // by which instants, for the legend; a reference has this session's times
    this.detail = null;
    this.hasTiles = false;
    this.loader = new Loader((query, stop) => this.request(query, stop), (bins) => {
      this.detail = bins;
      onChange();
    }, onError);
  }

  /** Return its name for the legend, and how it is aligned. */
  get title() { return this.aligned ? `${this.name}: ${this.aligned}` : this.name; }

  /** Load the whole series. */
  async begin(widthPx) {
    this.answer = await this.ask({ points: Math.max(50, Math.round(widthPx / 2)) });
    this.durationS = this.answer.duration_s;
    this.move(0);
  }

  /**
   * Match tiles by serial; if no serial matches and the counts are equal (another foot), by order.
   * @param {string[]} serials of this session
   */
  matchTiles(serials) {
    const theirs = this.answer.serials;
    const inOrder = theirs.length === serials.length && !theirs.some((serial) => serials.includes(serial));
    serials.forEach((serial, i) => {
      const j = inOrder ? i : theirs.indexOf(serial);
      if (j >= 0 && `force_n_${j}_max` in this.answer.columns) this.columns[`tile-${i}`] = [`force_n_${j}_min`, `force_n_${j}_max`];
    });
    this.hasTiles = "force_n_0_max" in this.answer.columns;
  }

  /** Shift the overlay by some seconds. */
  move(shiftS) {
    this.shiftS = shiftS;
    this.detail = null;
    this.loader.abort();
    this.whole = new Bins(shifted(this.answer, shiftS), { from: -Infinity, to: Infinity });
  }

  /**
   * Request bins on its own time axis; outside of it return none.
   * @param {import("../common/api.js").OverviewQuery} query
   * @param {AbortSignal} [stop]
   */
  async request({ points, start_s: startS, end_s: endS }, stop) {
    const [begin, end] = [startS - this.shiftS, endS - this.shiftS];
    if (end <= 0 || begin > this.durationS) return shifted(emptied(this.answer), this.shiftS);
    return shifted(await this.ask({ points, start_s: Math.max(0, begin), end_s: end }, stop), this.shiftS);
  }

  /** @param {View} view */
  best(view) { return this.detail?.contains(view) ? this.detail : this.whole; }

  want(view, widthPx) { this.loader.want(view, widthPx, this.best(view)); }

  extremes(key, view) {
    const columns = this.columns[key];
    const bins = this.best(view);
    return columns ? bins.extremes(...columns, ...bins.within(view)) : null;
  }

  draw(context, key, view, x, y, colour, widthPx) {
    const columns = this.columns[key];
    if (!columns) return;
    const bins = this.best(view);
    const [begin, end] = bins.within(view);
    drawSeries(context, bins, Math.max(0, begin - 1), Math.min(bins.count, end + 1), x, y, columns, colour, widthPx);
  }

  /**
   * Return its force at an instant, for the readout.
   * @returns {[string, string, string][]}
   */
  readings(view, timeS) {
    const bins = this.best(view);
    const i = bins.at(timeS);
    if (i < 0 || !this.columns.grf) return [];
    const isNear = timeS >= bins.first[i] - NEAR_S && timeS <= bins.edge(i) + NEAR_S;
    const [low, high] = this.columns.grf.map((name) => bins.columns[name][i]);
    const value = !isNear || low === null || high === null ? "–" : low === high ? `${number(high)} N` : `${number(low)} to ${number(high)} N`;
    return [["beside", this.name, value]];
  }

  /** Write its numbers in view to data attributes. */
  writeData(view, box) {
    const bins = this.best(view);
    const [begin, end] = bins.within(view);
    const found = this.extremes("grf", view);
    setData(box, "besideMin", found ? String(found.low) : "");
    setData(box, "besideMax", found ? String(found.high) : "");
    setData(box, "besideFirstS", end > begin ? String(bins.first[begin]) : "");
    setData(box, "besideLastS", end > begin ? String(bins.last[end - 1]) : "");
  }
}

const shifted = (answer, byS) => ({
  ...answer,
  serials: answer.serials ?? [],
  columns: {
    part: answer.columns.t_first_s.map(() => 0), // a comparison has none
    ...answer.columns,
    t_first_s: answer.columns.t_first_s.map((timeS) => timeS + byS),
    t_last_s: answer.columns.t_last_s.map((timeS) => timeS + byS),
  },
});

const emptied = (answer) => ({
  ...answer, frames_in_bin: 1, columns: Object.fromEntries(Object.keys(answer.columns).map((name) => [name, []])),
});
