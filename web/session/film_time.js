// Times of a film: its pictures, their instants in the session, and how sure those are. Pure.

import { number } from "../common/text.js";
import { lowerBound } from "./bins.js";

const Z95 = 1.96;

/** Return the index of the picture nearest to an instant. @param {number[]} times of all pictures, rising @param {number} filmS */
export function pictureAt(times, filmS) {
  const next = Math.min(times.length - 1, lowerBound(times, filmS));
  return next > 0 && filmS - times[next - 1] < times[next] - filmS ? next - 1 : next;
}

/** Return the index of the last picture that begins before an instant or at it; before all, the first. @param {number[]} times of all pictures, rising @param {number} filmS */
export function pictureBefore(times, filmS) {
  const next = lowerBound(times, filmS);
  return times[next] === filmS ? next : Math.max(0, next - 1);
}

/** Return how long a picture is shown; the last as long as the one before it. */
export function intervalOf(times, index) {
  const before = Math.min(index, times.length - 2);
  return before < 0 ? 0.04 : times[before + 1] - times[before];
}

/** Line from a film's time to the session's, s after its first frame. */
export class Line {
  /** @param {Alignment} alignment @param {number} beginNs of the session's first frame */
  constructor(alignment, beginNs) {
    this.of = alignment;
    this.atS = (alignment.t_ns - beginNs) * 1e-9;
  }

  toSession(filmS) { return this.atS + (filmS - this.of.film_s) * (1 + this.of.drift); }

  toFilm(sessionS) { return this.of.film_s + (sessionS - this.atS) / (1 + this.of.drift); }

  /** Return the half width of the 95 % interval of an instant, in s. */
  halfWidth(filmS) { return Z95 * Math.hypot(this.of.sigma_ns * 1e-9, (filmS - this.of.film_s) * this.of.sigma_drift); }

  /** Say method, offset, drift and their intervals. */
  get text() {
    const { method, drift, sigma_drift: sigma, pair_count: pairs, rejected_count: rejected } = this.of;
    const out = rejected ? `, ${rejected} left out: they contradict the others` : "";
    return `Aligned by ${method}: the film begins at ${number(this.toSession(0), 4)} s ${halfWidthText(this.halfWidth(0))}, drift ${number(1e6 * drift, 0)} `
      + `± ${number(1e6 * Z95 * sigma, 0)} ppm, from ${pairs} ${pairs === 1 ? "pair" : "pairs"} of instants${out}.`;
  }
}

/** Format the half width of a 95 % interval, such as "± 1.2 ms (95 %)". */
export function halfWidthText(halfS) {
  const ms = 1e3 * halfS;
  return `±\u00a0${ms < 1000 ? `${number(ms, ms < 0.1 ? 3 : ms < 10 ? 1 : 0)}\u00a0ms` : `${number(halfS, 1)}\u00a0s`} (95\u00a0%)`;
}

/**
 * Return a pair of instants. A person finds a picture to within one on both sides, and points to within a pixel;
 * of a touchdown the last picture or frame before it and the first after it are known.
 * @param {"hand" | "contact"} method @param {number[]} times @param {number} index
 * @param {number} sessionS @param {number} beginNs @param {number} resolutionS of the session's instant
 */
export function pairOf(method, times, index, sessionS, beginNs, resolutionS) {
  const intervalS = intervalOf(times, Math.max(0, index - 1));
  const contactS = sessionS - (method === "contact" ? resolutionS / 2 : 0);
  const filmS = times[index] - (method === "contact" ? intervalS / 2 : 0);
  const sigmaS = Math.hypot(2 * intervalS, resolutionS) / Math.sqrt(12);
  return { film_s: filmS, t_ns: Math.round(beginNs + 1e9 * contactS), sigma_ns: 1e9 * sigmaS };
}
