// Series over time: min-max columns, single frames, or colours.

const PALE = 0.25; // a bin that is mostly gap

/**
 * Yield index ranges [begin, end) of adjacent bins with values; a bin that is mostly gap is by itself.
 * @returns {Generator<[number, number]>}
 */
function* runs(bins, begin, end, known) {
  let start = -1;
  for (let i = begin; i < end; i++) {
    const here = known(i);
    if (start >= 0 && (!here || !bins.isAdjacent(i) || bins.isMostlyGap(i) || bins.isMostlyGap(i - 1))) {
      yield [start, i];
      start = -1;
    }
    if (here && start < 0) start = i;
  }
  if (start >= 0) yield [start, end];
}

/** Trace the outline of min and max of a run: steps, or from frame to frame. */
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

/** Fill the outline of a run, pale where it is mostly gap: its values are somewhere in it. */
function fillOutline(context, bins, run, x, y, lows, highs) {
  const { globalAlpha } = context;
  if (bins.isMostlyGap(run[0])) context.globalAlpha *= PALE;
  outline(context, bins, run, x, y, lows, highs);
  context.fill();
  context.globalAlpha = globalAlpha;
}

/** Draw a band between two columns, such as an interval. */
export function drawBand(context, bins, begin, end, x, y, [lowName, highName], colour) {
  const [lows, highs] = [bins.columns[lowName], bins.columns[highName]];
  context.fillStyle = colour;
  for (const run of runs(bins, begin, end, (i) => lows[i] !== null && highs[i] !== null)) {
    fillOutline(context, bins, run, x, y, lows, highs);
  }
}

const SIGN_PX = 10; // from sign to sign

/**
 * Draw signs at the edges of a plot where a band reaches beyond them; return true if there are some.
 * @param {{left: number, right: number, top: number, bottom: number}} box
 */
export function drawClipped(context, bins, begin, end, x, y, [lowName, highName], box, colour) {
  let some = false;
  context.strokeStyle = colour;
  context.lineWidth = 1.5;
  context.beginPath();
  for (const [name, tip, down, isBeyond] of /** @type {[string, number, number, (px: number) => boolean][]} */ ([
    [highName, box.top, 3.5, (px) => px < box.top - 1], [lowName, box.bottom, -3.5, (px) => px > box.bottom + 1],
  ])) {
    let free = box.left + 3;
    for (let i = begin; i < end; i++) {
      const value = bins.columns[name][i];
      if (value === null || !isBeyond(y(value))) continue;
      // Over the whole width of a bin; at a single frame.
      const to = Math.min(box.right - 3, x(bins.framesInBin > 1 ? bins.edge(i) : bins.first[i]));
      for (let at = Math.max(free, x(bins.first[i])); at <= to; at += SIGN_PX) {
        context.moveTo(at - 3, tip + down);
        context.lineTo(at, tip);
        context.lineTo(at + 3, tip + down);
        free = at + SIGN_PX;
        some = true;
      }
    }
  }
  context.stroke();
  return some;
}

/** Draw a quantity: min-max columns keep every peak; single frames as dots and lines. */
export function drawSeries(context, bins, begin, end, x, y, [lowName, highName], colour, widthPx = 1.5) {
  const [lows, highs] = [bins.columns[lowName], bins.columns[highName]];
  context.fillStyle = context.strokeStyle = colour;
  context.lineJoin = "round";
  const dots = bins.framesInBin === 1 && end - begin > 1
    && (x(bins.last[end - 1]) - x(bins.first[begin])) / (end - begin) > 5;
  for (const [start, stop] of runs(bins, begin, end, (i) => lows[i] !== null && highs[i] !== null)) {
    if (bins.framesInBin > 1) {
      context.lineWidth = widthPx - 0.5; // beside the filled area
      fillOutline(context, bins, [start, stop], x, y, lows, highs);
      if (!bins.isMostlyGap(start)) context.stroke();
      continue;
    }
    context.lineWidth = widthPx;
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

/** Draw the lower bound where the quantity is unknown. */
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

/** Return colours between stops, as RGBA bytes. */
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
 * Draw a row of colours per tile: max of the bins in each pixel column.
 * @param {{names: string[], ranges: {low: number, high: number}[], stops: string[]}} how `names` of the max
 *   columns, one per row; `high` may be below `low` (counts fall with pressure)
 */
export function drawHeat(context, bins, begin, end, x, box, how) {
  const width = Math.max(1, Math.round(box.right - box.left));
  const rows = how.names.length;
  const shades = shadesOf(context, how.stops);
  const picture = new ImageData(width, rows);
  const best = new Float64Array(width);
  how.names.forEach((name, row) => {
    const values = bins.columns[name];
    const { low, high } = how.ranges[row] ?? how.ranges[0];
    best.fill(NaN);
    for (let i = begin; i < end; i++) {
      if (values[i] === null) continue;
      const share = (values[i] - low) / (high - low);
      const from = Math.max(0, Math.floor(x(bins.first[i]) - box.left));
      const to = Math.min(width - 1, Math.max(from, Math.ceil(x(bins.edge(i)) - box.left) - 1));
      for (let at = from; at <= to; at++) if (!(best[at] >= share)) best[at] = share;
    }
    for (let at = 0; at < width; at++) {
      if (Number.isNaN(best[at])) continue; // unknown
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
