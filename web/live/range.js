// Up to which value bars and colours go: what each tile bears, or what the foot bears just now.

import { setText } from "../common/text.js";
import { isPlan } from "../common/foot_layout.js";
import { fullScale } from "./tile.js";

const STEPS = [1, 2, 3, 4, 5, 6, 8, 10, 12, 15, 20, 25, 30, 40, 50, 60, 80, 100, 150, 200, 300, 500, 1000];
const SHRINK_AFTER_MS = 4000; // a scale that follows every step of the robot cannot be read
const KEY = "foottile.range";

export class Range {
  /** `button` changes it, if there is one; `onChange()` when another was chosen. */
  constructor(button = null, onChange = () => {}) {
    this.button = button;
    this.chosen = null;
    this.tops = { N: following(), kPa: following() };
    if (!button) return;
    try { this.chosen = localStorage.getItem(KEY); } catch { /* private window */ }
    button.addEventListener("click", () => {
      this.chosen = this.automatic ? "fixed" : "automatic";
      try { localStorage.setItem(KEY, this.chosen); } catch { /* private window */ }
      this.show();
      onChange();
    });
  }

  /** Once for each drawing. Fixed unless another was chosen, but for grids, where neighbours are compared. */
  see(node, frame, nowMs) {
    const asked = this.chosen ?? (this.button && node.tiles.length && isPlan(node.tiles) ? "automatic" : "fixed");
    this.automatic = asked === "automatic";
    this.full = Math.max(0, ...node.tiles.filter((tile) => !tile.reference).map((tile) => fullScale(tile, "N")));
    this.tops.N.see(frame?.force_max_n, nowMs);
    this.tops.kPa.see(frame?.gauge_max_kpa, nowMs);
    this.show();
  }

  show() {
    if (this.button) setText(this.button, this.automatic ? "Range: automatic" : "Range: fixed");
  }

  /** Of the bar of a tile. */
  of(tile, unit) {
    return this.automatic ? this.tops[unit].value : fullScale(tile, unit);
  }

  /** Of all tiles' colours, in newtons. */
  get ofAll() {
    return this.automatic ? this.tops.N.value : this.full;
  }
}

/** The top of a scale: up at once, down only after a while. */
export function following() {
  return {
    value: STEPS[0],
    smallerSinceMs: null,
    see(values, nowMs) {
      const most = Math.max(0, ...(values ?? []).filter(Number.isFinite));
      const need = STEPS.find((step) => step >= most) ?? STEPS.at(-1);
      if (need >= this.value) this.smallerSinceMs = null;
      else this.smallerSinceMs ??= nowMs;
      if (need > this.value || (this.smallerSinceMs !== null && nowMs - this.smallerSinceMs > SHRINK_AFTER_MS)) {
        this.value = need;
        this.smallerSinceMs = null;
      }
    },
  };
}
