// Menu of a button: one at a time, arrow keys, closed by Escape or a tap outside.

import { el } from "./text.js";

const GAP_PX = 4; // to the button, and to the edge of the window

/** @type {{menu: HTMLElement, button: HTMLElement} | null} */
let shown = null;

/**
 * Make a button that opens a menu. `items()` returns its links and buttons when pressed.
 * @param {string} label of the button and of the menu
 * @param {() => HTMLElement[]} items
 */
export function menuButton(label, items) {
  const button = el("button", { type: "button", cls: "small menu-button", text: "⋯", "aria-label": label, "aria-haspopup": "menu", "aria-expanded": "false", "data-part": "menu" });
  button.addEventListener("click", () => {
    const wasOpen = shown?.button === button;
    closeMenu();
    if (!wasOpen) openMenu(button, label, items());
  });
  return button;
}

/** Close the open menu. @param {{refocus?: boolean}} [how] refocus: put the focus on its button */
export function closeMenu({ refocus = false } = {}) {
  if (!shown) return;
  const { menu, button } = shown;
  shown = null;
  menu.remove();
  button.setAttribute("aria-expanded", "false");
  if (refocus && button.isConnected) button.focus();
}

function openMenu(button, label, items) {
  const menu = el("div", { cls: "menu", role: "menu", "aria-label": label }, ...items);
  for (const item of items) {
    item.tabIndex = -1;
    if (item.getAttribute("role") === "menuitemcheckbox") continue; // its state is read before the menu is closed
    item.setAttribute("role", "menuitem");
    item.addEventListener("click", () => closeMenu({ refocus: true }));
  }
  menu.addEventListener("keydown", (event) => pressKey(event, items));
  document.querySelector("main").append(menu);
  shown = { menu, button };
  button.setAttribute("aria-expanded", "true");
  placeMenu(menu, button.getBoundingClientRect());
  items[0]?.focus();
}

/** Place the menu under the button, right-aligned; above it if there is no room. */
function placeMenu(menu, at) {
  const { offsetWidth: widthPx, offsetHeight: heightPx } = menu;
  const below = at.bottom + GAP_PX;
  const topPx = below + heightPx <= innerHeight ? below : Math.max(GAP_PX, at.top - GAP_PX - heightPx);
  menu.style.left = `${Math.max(GAP_PX, at.right - widthPx)}px`;
  menu.style.top = `${topPx}px`;
}

function pressKey(event, items) {
  const at = items.indexOf(/** @type {HTMLElement} */ (document.activeElement));
  const next = { ArrowDown: at + 1, ArrowUp: at - 1, Home: 0, End: -1 }[event.key];
  if (next !== undefined) items.at(next % items.length).focus();
  else if (event.key === "Escape") closeMenu({ refocus: true });
  else if (event.key === "Tab") return closeMenu({ refocus: true }); // the browser continues from the button
  else return;
  event.preventDefault();
}

addEventListener("pointerdown", ({ target }) => {
  if (target instanceof Node && !shown?.menu.contains(target) && !shown?.button.contains(target)) closeMenu();
});
addEventListener("resize", () => closeMenu());
addEventListener("scroll", ({ target }) => { if (target === document) closeMenu(); }, true);
