// Sunlight mode: highest contrast, stored per device, for all pages.

import { isChosen, storeChoice } from "./choice.js";
import { byId } from "./text.js";

const KEY = "foottile.sunlight";

/** Apply the stored mode and bind its button. */
export function inSunlight() {
  const button = byId("sun");
  let chosen = isChosen(KEY);
  const show = () => {
    document.documentElement.dataset.sunlight = String(chosen);
    button.setAttribute("aria-pressed", String(chosen));
    document.dispatchEvent(new Event("foottile-colours")); // canvases read their colours again
  };
  button.addEventListener("click", () => {
    chosen = !chosen;
    storeChoice(KEY, chosen);
    show();
  });
  show();
}
