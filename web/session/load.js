// Asks the server for bins of what is in view; a question that is out of date is taken back.

import { Bins } from "./bins.js";

const WAIT_MS = 60; // a wheel turns on: only where it stops is asked for
const MARGIN = 0.15; // of the view, on both sides
const VALUES_MOST = 120_000; // an answer has up to four times as many

/** @param {number} widthPx @param {number} tiles */
export const pointsFor = (widthPx, tiles) =>
  Math.round(Math.max(50, Math.min(0.6 * widthPx, VALUES_MOST / (20 + 3 * tiles), 2000)));

export class Loader {
  /**
   * @param {(query: OverviewQuery, stop?: AbortSignal) => Promise<Overview>} question
   * @param {(bins: Bins) => void} onBins @param {(error: Error) => void} onError
   */
  constructor(question, onBins, onError) {
    this.question = question;
    this.onBins = onBins;
    this.onError = onError;
    this.asked = null; // what the newest answer or question is about
    this.stopping = null;
    this.timer = null;
    this.busy = false; // finer bins are on their way
  }

  async whole(widthPx) {
    const answer = await this.question({ points: pointsFor(widthPx, 8) });
    return new Bins(answer, { from: -Infinity, to: Infinity });
  }

  /** What was asked for is out of date. */
  forget() {
    clearTimeout(this.timer);
    this.stopping?.abort();
    this.stopping = this.asked = null;
    this.busy = false;
  }

  /** Bins of a view, soon: none are asked for if `best` has the frames themselves already. */
  want(view, widthPx, best) {
    const key = `${view.from} ${view.to} ${widthPx}`;
    if (key === this.asked) return;
    this.asked = key;
    clearTimeout(this.timer);
    this.stopping?.abort();
    this.stopping = null;
    this.busy = best.framesInBin > 1 || !best.contains(view);
    if (!this.busy) return;
    this.timer = setTimeout(() => this.ask(view, widthPx, best), WAIT_MS);
  }

  async ask(view, widthPx, best) {
    const stopping = this.stopping = new AbortController();
    const margin = MARGIN * (view.to - view.from);
    const covers = { from: Math.max(0, view.from - margin), to: view.to + margin };
    try {
      const answer = await this.question({
        points: pointsFor(widthPx * (1 + 2 * MARGIN), best.serials.length), start_s: covers.from, end_s: covers.to,
      }, stopping.signal);
      if (stopping.signal.aborted) return;
      this.busy = false;
      this.onBins(new Bins(answer, covers));
    } catch (error) {
      if (stopping.signal.aborted) return;
      this.busy = false;
      this.asked = null; // the next move asks again
      this.onError(/** @type {Error} */ (error));
    }
  }
}
