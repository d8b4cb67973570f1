// Switches of this device, stored in the browser for all pages.

/** Return true if a switch was left on. @param {string} key */
export function isChosen(key) {
  try { return localStorage.getItem(key) === "true"; } catch { return false; } // private window
}

/** Store a switch. @param {string} key @param {boolean} on */
export function storeChoice(key, on) {
  try { localStorage.setItem(key, String(on)); } catch { /* private window */ }
}
