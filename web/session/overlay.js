// Over all plots: stances with numbers, markers, time axis.

import { crisp, decimalsOf, ticks } from "../common/axes.js";
import { number, printable } from "../common/text.js";

/** @typedef {import("./plots.js").Plots} Plots */

export const HEAD_PX = 38; // markers and stance numbers

/** Format a time: seconds, from 60 s on minutes and seconds. */
export function timeLabel(timeS, step) {
  const decimals = decimalsOf(step);
  const rounded = Number(timeS.toFixed(decimals));
  if (rounded < 60) return number(rounded, decimals);
  const minutes = Math.floor(rounded / 60);
  const rest = (rounded - 60 * minutes).toFixed(decimals);
  return `${minutes}:${rest.padStart(decimals ? decimals + 3 : 2, "0")}`;
}

/** Format a time with its unit: "59.99 s", "1:00.00 min". */
export function timeText(timeS, step) {
  const label = timeLabel(timeS, step);
  return `${label} ${label.includes(":") ? "min" : "s"}`;
}

/** @param {Plots} plots */
export function drawStances(plots, context, view, x, bottom, current) {
  const { colours } = plots;
  context.textAlign = "center";
  context.textBaseline = "bottom";
  let freeFrom = -Infinity;
  plots.stances.forEach((stance, i) => {
    if (stance.to < view.from || stance.from > view.to) return;
    const [left, right] = [Math.max(plots.left, x(stance.from)), Math.min(plots.left + plots.plotWidth, x(stance.to))];
    context.fillStyle = colours.stance;
    context.fillRect(left, HEAD_PX - 4, Math.max(1, right - left), bottom - HEAD_PX + 4);
    context.fillStyle = i === current ? colours.text : colours.edge;
    context.fillRect(left, HEAD_PX - 6, Math.max(1, right - left), i === current ? 4 : 2);
    const middle = (left + right) / 2;
    const text = String(stance.number);
    const half = context.measureText(text).width / 2;
    if (middle - half < freeFrom) return; // no overlap
    freeFrom = middle + half + 6;
    context.fillStyle = i === current ? colours.text : colours.soft;
    context.fillText(text, middle, HEAD_PX - 6);
  });
}

/**
 * Draw a triangle at the peak of each stance, with its value if there is room; return the boxes they fill.
 * @param {Plots} plots @param {{left: number, right: number, top: number}} box @param {(value: number) => number} y
 * @returns {{left: number, right: number, top: number, bottom: number}[]}
 */
export function drawPeaks(plots, context, view, x, box, y) {
  const { colours } = plots;
  context.textAlign = "center";
  context.textBaseline = "bottom";
  context.lineJoin = "round";
  const filled = [];
  for (const { from, to, peakS, peak_grf_n: peak } of plots.stances) {
    if (peakS === null || peakS < view.from || peakS > view.to) continue;
    const [at, tip] = [x(peakS), y(peak) - 2];
    context.fillStyle = colours.text;
    context.beginPath();
    context.moveTo(at, tip);
    context.lineTo(at - 4, tip - 6);
    context.lineTo(at + 4, tip - 6);
    context.fill();
    const text = number(peak);
    const width = context.measureText(text).width;
    filled.push({ left: at - 5, right: at + 5, top: tip - 7, bottom: tip });
    if (x(to) - x(from) < width + 4) continue;
    const middle = Math.min(box.right - width / 2, Math.max(box.left + width / 2, at));
    context.lineWidth = 3;
    context.strokeStyle = colours.page;
    context.strokeText(text, middle, tip - 6);
    context.fillText(text, middle, tip - 6);
    filled.push({ left: middle - width / 2 - 2, right: middle + width / 2 + 2, top: tip - 22, bottom: tip - 6 });
  }
  return filled;
}

/** @param {Plots} plots */
export function drawTime(plots, context, view, x, bottom) {
  const { colours } = plots;
  const { step, values } = ticks(view.from, view.to, Math.max(3, plots.plotWidth / (plots.width < 600 ? 55 : 90)));
  context.strokeStyle = colours.edge;
  context.lineWidth = 1;
  context.beginPath();
  context.moveTo(plots.left, crisp(bottom));
  context.lineTo(plots.left + plots.plotWidth, crisp(bottom));
  for (const value of values) {
    context.moveTo(crisp(x(value)), bottom);
    context.lineTo(crisp(x(value)), bottom + 5);
  }
  context.stroke();
  context.fillStyle = colours.text;
  context.textBaseline = "top";
  for (const [i, value] of values.entries()) {
    context.textAlign = "center";
    const text = (i === values.length - 1 ? timeText : timeLabel)(value, step);
    const half = context.measureText(text).width / 2;
    context.fillText(text, Math.min(plots.width - half - 1, Math.max(half + 1, x(value))), bottom + 8);
  }
}

/** Draw the markers' flags, labels as far as there is room. */
export function drawMarkers(plots, context, view, x, bottom) {
  const { colours } = plots;
  context.textAlign = "left";
  context.textBaseline = "middle";
  let freeFrom = -Infinity;
  plots.flags = [];
  for (const marker of plots.markers) {
    if (marker.timeS < view.from || marker.timeS > view.to) continue;
    const at = crisp(x(marker.timeS));
    context.strokeStyle = colours.text;
    context.lineWidth = 1.5;
    context.setLineDash([4, 3]);
    context.beginPath();
    context.moveTo(at, 15);
    context.lineTo(at, bottom);
    context.stroke();
    context.setLineDash([]);
    const label = [...printable(marker.label)];
    let text = label.length > 24 ? `${label.slice(0, 23).join("")}…` : label.join("");
    let width = context.measureText(text).width + 10;
    const before = at + width > plots.width; // no room on the right: flag to the left
    if ((before ? at - width : at) < freeFrom) { text = ""; width = 8; }
    const left = before ? at - width : at - 1;
    freeFrom = left + width + 2;
    context.fillStyle = colours.text;
    context.fillRect(left, 0, width, 16);
    context.fillStyle = colours.page;
    context.fillText(text, left + 5, 8.5);
    plots.flags.push({ id: marker.id, left, right: left + width });
  }
}

/** Return the id of the marker whose flag is at a position; null: none. @param {Plots} plots */
export function flagAt(plots, px, py) {
  const inside = plots.flags.filter(({ left, right }) => py <= 20 && px >= left - 4 && px <= right + 4);
  return inside.at(-1)?.id ?? null;
}
