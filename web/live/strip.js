// Scrolling picture over time: old pixels are shifted, new points are added.

const AHEAD_S = 0.25; // margin for time stamps after now: clocks differ a little

/** Off-screen canvas that scrolls. */
export class Strip {
  constructor() {
    this.canvas = document.createElement("canvas");
    this.context = this.canvas.getContext("2d");
    /** Key of the content; another key clears the picture. */
    this.key = "";
    this.endS = 0;
    this.drawnS = -Infinity;
  }

  /**
   * @param {{timeS: number}[]} points oldest first; drawn ones do not change
   * @param {object} how
   * @param {number} how.endS time at the right edge
   * @param {number} how.windowS time from left to right edge
   * @param {number} how.widthPx
   * @param {number} how.heightPx
   * @param {string} how.key changes with points before `drawnS` and with their style
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

  /** Copy the window to another canvas, upper left corner at (left, top). */
  show(context, left, top, widthPx, heightPx) {
    const ratio = devicePixelRatio || 1;
    context.drawImage(this.canvas, 0, 0, widthPx * ratio, heightPx * ratio, left, top, widthPx, heightPx);
  }
}
