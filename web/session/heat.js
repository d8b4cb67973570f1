// Forces of many tiles as colours, one row per tile, with a colour scale.

import { crisp } from "../common/axes.js";
import { number, printable } from "../common/text.js";
import { drawHeat } from "./series.js";

const STOPS = ["heat-0", "heat-1", "heat-2", "heat-3"];

/** Draw the rows. @param {import("./plots.js").Plots} plots */
export function drawTiles(plots, context, panel, box, view, x) {
  const { colours, whole } = plots;
  const counts = !whole.estimated;
  const serials = panel.besideOnly ? plots.beside.answer.serials : whole.serials;
  const names = serials.map((_, i) => (counts ? `pressure_raw_${i}_${whole.countsFall[i] ? "min" : "max"}` : `force_n_${i}_max`));
  plots.heat ??= counts ? whole.serials.map((_, i) => whole.countRange(i)) : [forceRange(whole)];
  const [{ low, high }] = plots.heat;
  const stops = STOPS.map((name) => colours[name]);
  const rows = names.length;
  const rowPx = (box.bottom - box.top) / rows;
  for (const [bins, from, to] of panel.besideOnly ? [[plots.beside.best(view), view.from, view.to]] : plots.layers(view)) {
    const [begin, end] = bins.within({ from, to });
    drawHeat(context, bins, begin, end, x, { ...box, left: x(from), right: x(to) }, { names, ranges: plots.heat, stops });
  }
  context.strokeStyle = colours.edge;
  context.lineWidth = 1;
  context.strokeRect(crisp(box.left), crisp(box.top), box.right - box.left - 1, box.bottom - box.top);
  context.fillStyle = colours.text;
  context.textAlign = "right";
  context.textBaseline = "middle";
  const every = Math.max(1, Math.ceil(13 / rowPx));
  for (let i = 0; i < rows; i += every) context.fillText(printable(serials[i]), box.left - 6, box.top + (i + 0.5) * rowPx);
  // Colour scale, right of the title.
  const bar = { left: box.right - 130, right: box.right - 60, top: box.top - 14, bottom: box.top - 4 };
  const blend = context.createLinearGradient(bar.left, 0, bar.right, 0);
  stops.forEach((stop, i) => blend.addColorStop(i / (stops.length - 1), stop));
  context.fillStyle = blend;
  context.fillRect(bar.left, bar.top, bar.right - bar.left, bar.bottom - bar.top);
  context.strokeRect(crisp(bar.left), crisp(bar.top), bar.right - bar.left, bar.bottom - bar.top);
  context.fillStyle = colours.text;
  const decimals = high >= 20 ? 0 : 1;
  context.fillText(counts ? "least" : number(low, decimals), bar.left - 5, bar.top + 5);
  context.textAlign = "left";
  context.fillText(counts ? "most" : `${number(high, decimals)} ${panel.unit}`, bar.right + 5, bar.top + 6);
}

/** Return the range over the whole session: colours do not depend on the zoom. */
function forceRange(bins) {
  const tops = bins.serials.map((_, i) => bins.extremes(`force_n_${i}_min`, `force_n_${i}_max`, 0, bins.count)?.high ?? 0);
  return { low: 0, high: Math.max(0.1, ...tops) };
}
