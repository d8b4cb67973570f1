// Full scale of bars and colours: rated load of each tile, or the present load.

import { setText } from "../common/text.js";
import { isPlan } from "../common/foot_layout.js";
import { fullScale } from "./tile.js";

const STEPS = [1, 2, 3, 4, 5, 6, 8, 10, 12, 15, 20, 25, 30, 40, 50, 60, 80, 100, 150, 200, 300, 500, 1000];
const SHRINK_AFTER_MS = 4000; // longer than a step of the robot
const KEY = "foottile.range";

/** Fixed or automatic range. */
export class Range {
  /** `button` toggles the range; `onChange()` runs afterwards. */
  constructor(button = null, onChange = () => {}) {
    this.button = button;
    this.chosen = null;
    this.tops = { N: autoScale(), kPa: autoScale() };
    if (!button) return;
    try { this.chosen = localStorage.getItem(KEY); } catch { /* private window */ }
    button.addEventListener("click", () => {
      this.chosen = this.automatic ? "fixed" : "automatic";
      try { localStorage.setItem(KEY, this.chosen); } catch { /* private window */ }
      this.show();
      onChange();
    });
  }

  /** Update with each drawing. Default: fixed; on grids automatic, to compare neighbours. */
  update(node, frame, nowMs) {
    const mode = this.chosen ?? (this.button && node.tiles.length && isPlan(node.tiles) ? "automatic" : "fixed");
    this.automatic = mode === "automatic";
    this.tiles = node.tiles;
    this.tops.N.update(frame?.force_max_n, nowMs);
    this.tops.kPa.update(frame?.gauge_max_kpa, nowMs);
    this.show();
  }

  show() {
    if (this.button) setText(this.button, this.automatic ? "Range: auto" : "Range: fixed");
  }

  /** Return the full scale of a tile's bar. */
  of(tile, unit) {
    return this.automatic ? this.tops[unit].value : fullScale(tile, unit);
  }

  /** Return the full scale of the foot's colours. */
  ofFoot(unit) {
    return this.automatic ? this.tops[unit].value : Math.max(0, ...this.tiles.filter((tile) => !tile.reference).map((tile) => fullScale(tile, unit)));
  }
}

/** Return a scale that grows at once and shrinks after a delay. */
export function autoScale() {
  return {
    value: STEPS[0],
    smallerSinceMs: null,
    update(values, nowMs) {
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
