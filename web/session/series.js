// Draws numbers over time: columns from least to greatest, or the frames themselves, or colours.

/**
 * Stretches of bins in which nothing is missing and the numbers are known.
 * @returns {Generator<[number, number]>} from, up to but not including
 */
function* runs(bins, begin, end, known) {
  let start = -1;
  for (let i = begin; i < end; i++) {
    const here = known(i);
    if (start >= 0 && (!here || !bins.follows(i))) {
      yield [start, i];
      start = -1;
    }
    if (here && start < 0) start = i;
  }
  if (start >= 0) yield [start, end];
}

/** The outline around least and greatest of a run: steps, or from frame to frame. */
function outline(context, bins, [start, stop], x, y, lows, highs) {
  const stepped = bins.framesInBin > 1;
  context.beginPath();
  for (let i = start; i < stop; i++) {
    context.lineTo(x(bins.first[i]), y(highs[i]));
    if (stepped) context.lineTo(x(i + 1 < stop ? bins.first[i + 1] : bins.last[i]), y(highs[i]));
  }
  for (let i = stop - 1; i >= start; i--) {
    if (stepped) context.lineTo(x(i + 1 < stop ? bins.first[i + 1] : bins.last[i]), y(lows[i]));
    context.lineTo(x(bins.first[i]), y(lows[i]));
  }
  context.closePath();
}

/** A band between two columns, such as an interval. */
export function drawBand(context, bins, begin, end, x, y, [lowName, highName], colour) {
  const [lows, highs] = [bins.columns[lowName], bins.columns[highName]];
  context.fillStyle = colour;
  for (const run of runs(bins, begin, end, (i) => lows[i] !== null && highs[i] !== null)) {
    outline(context, bins, run, x, y, lows, highs);
    context.fill();
  }
}

/** One quantity: columns from its least to its greatest, so that no peak hides; frames as dots and lines. */
export function drawSeries(context, bins, begin, end, x, y, [lowName, highName], colour) {
  const [lows, highs] = [bins.columns[lowName], bins.columns[highName]];
  context.fillStyle = context.strokeStyle = colour;
  context.lineJoin = "round";
  const dots = bins.framesInBin === 1 && end - begin > 1
    && (x(bins.last[end - 1]) - x(bins.first[begin])) / (end - begin) > 5;
  for (const [start, stop] of runs(bins, begin, end, (i) => lows[i] !== null && highs[i] !== null)) {
    if (bins.framesInBin > 1) {
      context.lineWidth = 1;
      outline(context, bins, [start, stop], x, y, lows, highs);
      context.fill();
      context.stroke();
      continue;
    }
    context.lineWidth = 1.5;
    context.beginPath();
    for (let i = start; i < stop; i++) context.lineTo(x(bins.first[i]), y(highs[i]));
    context.stroke();
    if (!dots && stop - start > 1) continue;
    context.beginPath();
    for (let i = start; i < stop; i++) {
      context.moveTo(x(bins.first[i]) + 2, y(highs[i]));
      context.arc(x(bins.first[i]), y(highs[i]), 2, 0, 7);
    }
    context.fill();
  }
}

/** A bound where the quantity itself is not known: it is on this line or above. */
export function drawBound(context, bins, begin, end, x, y, name, colour) {
  const [bounds, unknown] = [bins.columns[name], bins.columns.grf_unknown];
  context.strokeStyle = colour;
  context.lineWidth = 2;
  context.beginPath();
  for (let i = begin; i < end; i++) {
    if (!unknown[i] || bounds[i] === null || bounds[i] <= 0) continue;
    context.moveTo(x(bins.first[i]), y(bounds[i]));
    context.lineTo(Math.max(x(bins.first[i]) + 1.5, x(bins.edge(i))), y(bounds[i]));
  }
  context.stroke();
}

const SHADES = 64;

/** Colours from the first to the last of some stops, as [r, g, b] each. */
function shadesOf(context, stops) {
  const strip = document.createElement("canvas");
  strip.width = SHADES;
  strip.height = 1;
  const draw = strip.getContext("2d", { willReadFrequently: true });
  const blend = draw.createLinearGradient(0, 0, SHADES, 0);
  stops.forEach((stop, i) => blend.addColorStop(i / (stops.length - 1), stop));
  draw.fillStyle = blend;
  draw.fillRect(0, 0, SHADES, 1);
  return draw.getImageData(0, 0, SHADES, 1).data;
}

/**
 * A row of colours for each tile: in every column of pixels the greatest value of its bins.
 * @param {{names: string[], low: number, high: number, stops: string[]}} how `names` of the columns
 *   of greatest values, in the order of the rows; `high` may be below `low` (counts fall with pressure)
 */
export function drawHeat(context, bins, begin, end, x, box, how) {
  const width = Math.max(1, Math.round(box.right - box.left));
  const rows = how.names.length;
  const shades = shadesOf(context, how.stops);
  const picture = new ImageData(width, rows);
  const best = new Float64Array(width);
  how.names.forEach((name, row) => {
    const values = bins.columns[name];
    best.fill(NaN);
    for (let i = begin; i < end; i++) {
      if (values[i] === null) continue;
      const share = (values[i] - how.low) / (how.high - how.low);
      const from = Math.max(0, Math.floor(x(bins.first[i]) - box.left));
      const to = Math.min(width - 1, Math.max(from, Math.ceil(x(bins.edge(i)) - box.left) - 1));
      for (let at = from; at <= to; at++) if (!(best[at] >= share)) best[at] = share;
    }
    for (let at = 0; at < width; at++) {
      if (Number.isNaN(best[at])) continue; // not known: nothing is drawn
      const shade = 4 * Math.round(Math.min(1, Math.max(0, best[at])) * (SHADES - 1));
      const pixel = 4 * (row * width + at);
      for (let part = 0; part < 3; part++) picture.data[pixel + part] = shades[shade + part];
      picture.data[pixel + 3] = 255;
    }
  });
  const small = document.createElement("canvas");
  small.width = width;
  small.height = rows;
  small.getContext("2d").putImageData(picture, 0, 0);
  context.imageSmoothingEnabled = false;
  context.drawImage(small, box.left, box.top, box.right - box.left, box.bottom - box.top);
}
