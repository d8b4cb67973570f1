// Legend of the plots, for the visible range.

import { byId, el } from "../common/text.js";

/** Draw the legend. @param {import("./plots.js").Plots} plots */
export function drawLegend(plots) {
  const keys = plots.panels.map((panel) => panel.key);
  const items = [];
  if (keys.includes("grf")) items.push(["interval", "95 % interval of GRF"], ["contact", "contact"]);
  if (keys.some((key) => key.startsWith("cop"))) items.push(["cop-interval", "95 % interval of COP"]);
  if (plots.clipped.size) items.push(["clipped", "interval reaches beyond the axis"]);
  if (plots.stances.length) items.push(["stance", "stance with number; ▾ peak"]);
  if (plots.beside) items.push(["own", plots.name], ["beside", plots.beside.title]);
  items.push(...plots.shownKinds.map(({ key, label }) => [key, key === "lost" && plots.whole.provisional ? "frames lost or pending" : label]));
  const list = byId("legend");
  const key = JSON.stringify(items);
  if (list.dataset.key === key) return;
  list.dataset.key = key;
  list.replaceChildren(...items.map(([name, text]) => el("li", { "data-kind": name }, el("i", { cls: `swatch ${name}`, "aria-hidden": "true" }), text)));
}
