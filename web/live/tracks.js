// Bars on one canvas over the tracks of all tiles: elements of changing size would need a layout thirty
// times a second.

import { coloursOf, fit, whenColoursChange } from "../common/axes.js";
import { byId } from "../common/text.js";

/**
 * Positions on a track, as shares of it.
 * @typedef {{zero: number, value?: number, low?: number, high?: number, peak?: number}} Bar
 */

/** Style of vertical and horizontal bars: thickness in pixels, positions across as shares. */
const UPRIGHT = { edge: 2, zero: 2, line: 4, peak: 4, peakFrom: 0.8, bandFrom: 0.25, bandTo: 0.75 };
const LYING = { edge: 1, zero: 1, line: 3, peak: 2, peakFrom: 0.6, bandFrom: 0.25, bandTo: 0.75 };

/** Canvas of the bars. */
export class Tracks {
  constructor() {
    this.canvas = byId("tracks", HTMLCanvasElement);
    /** @type {HTMLElement[]} */
    this.elements = [];
    /** @type {(Bar | null)[]} */
    this.bars = [];
    this.boxes = [];
    this.lying = false;
    this.width = this.height = 0;
    // Measured after a change of size: to measure while texts are written would force a layout.
    this.sizes = new ResizeObserver(() => this.measure());
    whenColoursChange(() => {
      this.colours = null;
      this.draw(this.bars);
    });
  }

  /** @param {HTMLElement[]} elements of the tiles, one each */
  over(elements) {
    this.elements = elements;
    this.bars = [];
    this.sizes.disconnect();
    for (const element of [this.canvas, ...elements]) this.sizes.observe(element);
  }

  measure() {
    const { left, top, width, height } = this.canvas.getBoundingClientRect();
    Object.assign(this, { width, height });
    this.boxes = this.elements.map((element) => {
      const box = element.getBoundingClientRect();
      return {
        left: box.left - left + element.clientLeft, top: box.top - top + element.clientTop,
        width: element.clientWidth, height: element.clientHeight,
      };
    });
    this.draw(this.bars);
  }

  /** @param {(Bar | null)[]} bars of the tiles; null: none */
  draw(bars) {
    this.bars = bars;
    if (!this.width || !this.height) return; // traces are shown instead
    this.colours ??= coloursOf(this.canvas, ["fill", "band", "text"]);
    const context = fit(this.canvas, this.width, this.height);
    bars.forEach((bar, i) => { if (bar && this.boxes[i]) drawBar(context, this.boxes[i], bar, this.lying, this.colours); });
  }
}

/**
 * @param {CanvasRenderingContext2D} context
 * @param {{left: number, top: number, width: number, height: number}} box of the track
 * @param {Bar} bar
 * @param {boolean} lying
 * @param {Record<string, string>} colours
 */
function drawBar(context, box, { zero, value, low, high, peak }, lying, colours) {
  const how = lying ? LYING : UPRIGHT;
  const [long, wide] = lying ? [box.width, box.height] : [box.height, box.width];
  // From `from` to `to` along the track, in pixels from its beginning.
  const fill = (colour, from, to, acrossFrom = 0, acrossTo = 1) => {
    const [begin, end, side, thick] = [Math.round(from), Math.round(to), Math.round(acrossFrom * wide), Math.round(acrossTo * wide) - Math.round(acrossFrom * wide)];
    context.fillStyle = colour;
    if (lying) context.fillRect(Math.round(box.left) + begin, Math.round(box.top) + side, end - begin, thick);
    else context.fillRect(Math.round(box.left) + side, Math.round(box.top + long) - end, thick, end - begin);
  };
  const centred = (share, thickness, acrossFrom = 0) => {
    const from = Math.round(share * long - thickness / 2);
    fill(colours.text, from, from + thickness, acrossFrom);
  };
  if (value !== undefined) fill(colours.fill, Math.min(zero, value) * long, Math.max(zero, value) * long);
  if (high !== undefined) {
    const from = low * long;
    const to = Math.max(high * long, from + 2 * how.edge);
    fill(colours.text, from, to, how.bandFrom, how.bandTo);
    fill(colours.band, Math.round(from) + how.edge, Math.round(to) - how.edge, how.bandFrom, how.bandTo);
  }
  fill(colours.text, zero * long, Math.round(zero * long) + how.zero);
  if (peak !== undefined) centred(peak, how.peak, how.peakFrom);
  if (value !== undefined) centred(value, how.line);
}
