// Canvas plots: resolution, colours of the style sheet, ticks, hatching.

/**
 * Fit a canvas to its box at the screen's resolution; return its context, in CSS pixels.
 * @param {HTMLCanvasElement} canvas
 * @param {number} width
 * @param {number} height
 * @param {number} [ratio]
 */
export function fit(canvas, width, height, ratio = devicePixelRatio || 1) {
  const [across, down] = [Math.round(width * ratio), Math.round(height * ratio)];
  if (canvas.width !== across || canvas.height !== down) {
    canvas.width = across;
    canvas.height = down;
  }
  const context = contextOf(canvas);
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  return context;
}

/** @param {HTMLCanvasElement} canvas */
function contextOf(canvas) {
  return /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d")); // null only for other kinds of contexts
}

/** Return the position of a sharp line of one pixel. @param {number} value */
export const crisp = (value) => Math.round(value) + 0.5;

/**
 * Return ticks in steps of 1, 2 or 5 times a power of ten within an interval.
 * @param {number} low
 * @param {number} high
 * @param {number} most maximum count
 * @returns {{step: number, values: number[]}}
 */
export function ticks(low, high, most) {
  const rough = (high - low) / Math.max(1, most);
  if (!(rough > 0) || !Number.isFinite(rough)) return { step: 1, values: [low] };
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = power * ([1, 2, 5].find((factor) => factor * power >= rough * 0.999) ?? 10);
  /** @type {number[]} */
  const values = [];
  for (let n = Math.ceil(low / step - 1e-6); n * step <= high + step * 1e-6; n++) values.push(n * step);
  return { step, values };
}

/** Return the decimals that distinguish two ticks. @param {number} step */
export const decimalsOf = (step) => Math.max(0, Math.min(6, -Math.floor(Math.log10(step) + 1e-9)));

/**
 * Return current colours of an element by the style sheet's variables.
 * @param {Element} element
 * @param {string[]} names
 * @returns {Record<string, string>}
 */
export function coloursOf(element, names) {
  const style = getComputedStyle(element);
  return Object.fromEntries(names.map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
}

/** Run `then` after a change of the colours. @param {() => void} then */
export function whenColoursChange(then) {
  for (const query of ["(prefers-color-scheme: dark)", "(forced-colors: active)", "(prefers-contrast: more)"]) {
    matchMedia(query).addEventListener("change", then);
  }
  document.addEventListener("foottile-colours", then);
}

const TILE_PX = 8;

/**
 * Return a hatching as a fill: "/", "\\" or both, "x".
 * @param {CanvasRenderingContext2D} context
 * @param {string} colour
 * @param {string} way
 */
export function hatching(context, colour, way) {
  const ratio = devicePixelRatio || 1;
  const tile = document.createElement("canvas");
  tile.width = tile.height = Math.round(TILE_PX * ratio);
  const draw = contextOf(tile);
  draw.scale(tile.width / TILE_PX, tile.height / TILE_PX);
  draw.strokeStyle = colour;
  draw.lineWidth = 1.2;
  for (const one of way === "x" ? ["/", "\\"] : [way]) {
    draw.beginPath();
    for (const shift of [-TILE_PX, 0, TILE_PX]) {
      draw.moveTo(shift - 1, one === "/" ? TILE_PX + 1 : -1);
      draw.lineTo(shift + TILE_PX + 1, one === "/" ? -1 : TILE_PX + 1);
    }
    draw.stroke();
  }
  const pattern = /** @type {CanvasPattern} */ (context.createPattern(tile, "repeat"));
  pattern.setTransform(new DOMMatrix().scale(TILE_PX / tile.width));
  return pattern;
}
