// The strongest contrast there is, for a screen in the sun: chosen on this device, for every page.

import { byId } from "./text.js";

const KEY = "foottile.sunlight";

/** Applies what was chosen; a page's button chooses. */
export function inSunlight() {
  const button = byId("sun");
  let chosen = false;
  try { chosen = localStorage.getItem(KEY) === "true"; } catch { /* private window */ }
  const show = () => {
    document.documentElement.dataset.sunlight = String(chosen);
    button.setAttribute("aria-pressed", String(chosen));
    document.dispatchEvent(new Event("foottile-colours")); // what is drawn reads its colours anew
  };
  button.addEventListener("click", () => {
    chosen = !chosen;
    try { localStorage.setItem(KEY, String(chosen)); } catch { /* private window */ }
    show();
  });
  show();
}
