// What every plot on a canvas has: sharpness, colours of the style sheet, steps of axes, hatching.

/**
 * Fit a canvas to its box at the screen's own pixels; its context, in CSS pixels from then on.
 * @param {HTMLCanvasElement} canvas
 * @param {number} width
 * @param {number} height
 */
export function fit(canvas, width, height) {
  const ratio = devicePixelRatio || 1;
  const [across, down] = [Math.round(width * ratio), Math.round(height * ratio)];
  if (canvas.width !== across || canvas.height !== down) {
    canvas.width = across;
    canvas.height = down;
  }
  const context = paper(canvas);
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  return context;
}

/** @param {HTMLCanvasElement} canvas */
function paper(canvas) {
  return /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d")); // null for other kinds of contexts only
}

/** A line of one pixel is sharp between two of them. @param {number} value */
export const crisp = (value) => Math.round(value) + 0.5;

/**
 * Steps of 1, 2 or 5 times a power of ten that lie within an interval.
 * @param {number} low
 * @param {number} high
 * @param {number} most how many at most
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

/** Decimals that tell two neighbouring steps apart. @param {number} step */
export const decimalsOf = (step) => Math.max(0, Math.min(6, -Math.floor(Math.log10(step) + 1e-9)));

/**
 * Colours by the names of the style sheet's variables, as they are for this element now.
 * @param {Element} element
 * @param {string[]} names
 * @returns {Record<string, string>}
 */
export function coloursOf(element, names) {
  const style = getComputedStyle(element);
  return Object.fromEntries(names.map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
}

/** Call when colours are others: at dusk, or in the sun. @param {() => void} then */
export function whenColoursChange(then) {
  for (const query of ["(prefers-color-scheme: dark)", "(forced-colors: active)", "(prefers-contrast: more)"]) {
    matchMedia(query).addEventListener("change", then);
  }
  document.addEventListener("foottile-colours", then);
}

const TILE_PX = 8;

/**
 * Stripes as a fill: "/", "\\" or both ways, "x".
 * @param {CanvasRenderingContext2D} context
 * @param {string} colour
 * @param {string} way
 */
export function hatching(context, colour, way) {
  const ratio = devicePixelRatio || 1;
  const tile = document.createElement("canvas");
  tile.width = tile.height = Math.round(TILE_PX * ratio);
  const draw = paper(tile);
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
