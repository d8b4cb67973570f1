// Requests of bins for the visible range; outdated requests are aborted.

import { Bins } from "./bins.js";

const WAIT_MS = 60; // debounce of the wheel
const MARGIN = 0.15; // of the view, on both sides
const VALUES_MAX = 120_000; // a response has up to four times as many

/** Return the number of bins to request. @param {number} widthPx @param {number} tiles */
export const pointsFor = (widthPx, tiles) =>
  Math.round(Math.max(50, Math.min(0.6 * widthPx, VALUES_MAX / (20 + 3 * tiles), 2000)));

/** Loads bins. */
export class Loader {
  /**
   * @param {(query: import("../common/api.js").OverviewQuery, stop?: AbortSignal) => Promise<OverviewView>} request
   * @param {(bins: Bins) => void} onBins @param {(error: Error) => void} onError
   */
  constructor(request, onBins, onError) {
    this.request = request;
    this.onBins = onBins;
    this.onError = onError;
    this.key = null; // of the latest request
    this.stopping = null;
    this.timer = null;
    this.busy = false; // finer bins are requested
  }

  async whole(widthPx) {
    const answer = await this.request({ points: pointsFor(widthPx, 8) });
    return new Bins(answer, { from: -Infinity, to: Infinity });
  }

  /** Abort the request. */
  abort() {
    clearTimeout(this.timer);
    this.stopping?.abort();
    this.stopping = this.key = null;
    this.busy = false;
  }

  /** Request bins of a view after a delay, unless `best` has single frames already. */
  want(view, widthPx, best) {
    const key = `${view.from} ${view.to} ${widthPx}`;
    if (key === this.key) return;
    this.key = key;
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
      const answer = await this.request({
        points: pointsFor(widthPx * (1 + 2 * MARGIN), best.serials.length), start_s: covers.from, end_s: covers.to,
      }, stopping.signal);
      if (stopping.signal.aborted) return;
      this.busy = false;
      this.onBins(new Bins(answer, covers));
    } catch (error) {
      if (stopping.signal.aborted) return;
      this.busy = false;
      this.key = null; // the next move requests again
      this.onError(/** @type {Error} */ (error));
    }
  }
}
