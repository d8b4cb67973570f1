// Plots as a PNG file with a title, and the overlay's.

import { coloursOf } from "../common/axes.js";
import { localTime, printable } from "../common/text.js";

const HEAD_PX = 34;
const LINE_PX = 20;

/** Download the picture. @param {import("./plots.js").Plots} plots */
export function savePicture(plots, session) {
  const ratio = plots.canvas.width / plots.width;
  const headPx = HEAD_PX + (plots.beside ? LINE_PX : 0);
  const canvas = document.createElement("canvas");
  canvas.width = plots.canvas.width;
  canvas.height = plots.canvas.height + Math.round(headPx * ratio);
  const context = canvas.getContext("2d");
  const { page, text } = coloursOf(plots.box, ["page", "text"]);
  context.fillStyle = page;
  context.fillRect(0, 0, canvas.width, canvas.height);
  context.drawImage(plots.canvas, 0, Math.round(headPx * ratio));
  context.scale(ratio, ratio);
  context.fillStyle = text;
  context.font = "700 14px system-ui, sans-serif";
  context.fillText(printable(`${session.name}, ${session.node}, ${localTime(new Date(session.started_t_ns / 1e6))}`), 8, 22, plots.width - 16);
  if (plots.beside) {
    context.font = "14px system-ui, sans-serif";
    context.fillText(printable(`with ${plots.beside.title}`), 8, 22 + LINE_PX, plots.width - 16);
  }
  saveCanvas(canvas, `${session.id}.png`);
}

/** Download a canvas as PNG. @param {HTMLCanvasElement} canvas @param {string} name */
export function saveCanvas(canvas, name) {
  canvas.toBlob((blob) => {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(blob);
    link.download = name;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
  });
}
