// What the plots show, in words: only what is in view.

import { byId, el } from "../common/text.js";

/** @param {import("./plots.js").Plots} plots */
export function drawLegend(plots) {
  const keys = plots.panels.map((panel) => panel.key);
  const items = [];
  if (keys.includes("grf")) items.push(["interval", "95 % interval of the force"], ["contact", "contact"]);
  if (keys.some((key) => key.startsWith("cop"))) items.push(["cop-interval", "95 % interval of the centre of pressure"]);
  if (plots.stances.length) items.push(["stance", "stance, by its number; ▾ its peak"]);
  if (plots.beside) items.push(["own", plots.name], ["beside", plots.beside.name]);
  items.push(...plots.shownKinds.map(({ key, says }) => [key, key === "lost" && plots.whole.provisional ? "frames that are not here, or not yet" : says]));
  const list = byId("legend");
  const key = JSON.stringify(items);
  if (list.dataset.key === key) return;
  list.dataset.key = key;
  list.replaceChildren(...items.map(([name, text]) => el("li", { "data-kind": name }, el("i", { cls: `swatch ${name}`, "aria-hidden": "true" }), text)));
}
