// A picture over time that only moves: what was drawn is shifted by whole pixels, and what is new is added.

const AHEAD_S = 0.25; // room for what is dated later than now, by clocks that are not quite one

export class Strip {
  constructor() {
    this.canvas = document.createElement("canvas");
    this.context = this.canvas.getContext("2d");
    /** Of what the picture is; of another one it begins anew. */
    this.key = "";
    this.endS = 0;
    this.drawnS = -Infinity;
  }

  /**
   * @param {{timeS: number}[]} points oldest first; those that were drawn stay as they are
   * @param {object} how
   * @param {number} how.endS what is at the right edge
   * @param {number} how.windowS from the left edge to the right
   * @param {number} how.widthPx
   * @param {number} how.heightPx
   * @param {string} how.key another one if points before `drawnS` have changed, or how they are drawn
   * @param {(context: CanvasRenderingContext2D, i: number, x: (timeS: number) => number) => void} draw point i
   */
  draw(points, { endS, windowS, widthPx, heightPx, key }, draw) {
    const { canvas, context } = this;
    const ratio = devicePixelRatio || 1;
    const perS = (widthPx * ratio) / windowS;
    const whole = [key, widthPx, heightPx, ratio, windowS].join();
    const shift = Math.round((endS + AHEAD_S - this.endS) * perS);
    if (whole !== this.key || shift < 0 || shift > canvas.width) {
      this.key = whole;
      canvas.width = Math.ceil((windowS + AHEAD_S) * perS);
      canvas.height = Math.round(heightPx * ratio);
      this.endS = endS + AHEAD_S;
      this.drawnS = -Infinity;
    } else if (shift) {
      context.globalCompositeOperation = "copy";
      context.setTransform(1, 0, 0, 1, 0, 0);
      context.drawImage(canvas, -shift, 0);
      context.globalCompositeOperation = "source-over";
      this.endS += shift / perS;
    }
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    const x = (timeS) => (canvas.width - (this.endS - timeS) * perS) / ratio;
    let first = points.length;
    while (first && points[first - 1].timeS > this.drawnS) first--;
    for (let i = first; i < points.length; i++) draw(context, i, x);
    this.drawnS = points.at(-1)?.timeS ?? -Infinity;
  }

  /** The window, with its left upper corner at a place of another canvas. */
  show(context, left, top, widthPx, heightPx) {
    const ratio = devicePixelRatio || 1;
    context.drawImage(this.canvas, 0, 0, widthPx * ratio, heightPx * ratio, left, top, widthPx, heightPx);
  }
}
