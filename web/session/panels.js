// Plots of a session, from its columns.

const HEAT_FROM = 9; // tiles; more traces are not readable
const FORCE_PX = 180;
const PLACE_PX = 76;
const TITLE_PX = 19; // above a plot; tiles have it inside

/**
 * @typedef {object} Panel
 * @property {string} key
 * @property {string} title
 * @property {string} unit
 * @property {"series" | "heat"} kind
 * @property {[string, string]} [columns] min and max
 * @property {[string, string]} [band] interval around it
 * @property {number} [least] range of values, in the unit shown, below which differences are noise; of a panel with a band
 * @property {string} [note] after the title; a phone has room for three words
 * @property {string} [bound] column of the lower bound
 * @property {string} [group] panels with a common scale
 * @property {number} [factor] from the column's unit to the one shown
 * @property {boolean} [force] faults of forces are drawn over it
 * @property {boolean} [zero] the scale contains zero
 * @property {boolean} [besideOnly] shows the overlay only
 * @property {number} height
 * @property {number} head space for the title
 * @property {number} [tile]
 */

/**
 * Return the panels from top to bottom.
 * @param {import("./bins.js").Bins} bins of the whole session
 * @param {boolean | null} asHeat tiles as colours; null: by their number
 * @param {import("./beside.js").Beside | null} [beside]
 * @returns {Panel[]}
 */
export function panelsOf(bins, asHeat, beside = null) {
  const tiles = bins.serials;
  const panels = [];
  if (bins.estimated) {
    panels.push({
      key: "grf", title: "Ground reaction force", unit: "N", kind: "series", columns: ["grf_n_min", "grf_n_max"],
      band: ["grf_low_n_min", "grf_high_n_max"], least: 1, bound: "grf_lower_bound_n_max", force: true, zero: true, height: FORCE_PX, head: TITLE_PX,
    });
  }
  if (bins.estimated && beside?.columns.difference) {
    panels.push({
      key: "difference", title: `FootTile minus ${beside.name}`, unit: "N", kind: "series", columns: beside.columns.difference,
      besideOnly: true, zero: true, height: PLACE_PX, head: TITLE_PX,
    });
  }
  const [stem, unit] = bins.estimated ? ["force_n", "N"] : ["pressure_raw", "counts"];
  const isWide = (i) => !bins.estimated && bins.countRange(i).low >= 1e5;
  const names = (i) => /** @type {[string, string]} */ ([`${stem}_${i}_min`, `${stem}_${i}_max`]);
  // Reference tiles have no force; failed tiles are shown.
  const known = tiles.map((_, i) => i).filter((i) => bins.has(names(i)[1]) || bins.columns[`tile_flags_${i}`].some(Boolean));
  if (asHeat ?? tiles.length >= HEAT_FROM) {
    panels.push({
      key: "tiles", title: bins.estimated ? "Force per tile" : "Load of each tile",
      unit: bins.estimated ? unit : "by its raw counts", kind: "heat", force: true, height: Math.min(420, Math.max(90, tiles.length * (tiles.length > 24 ? 7 : 14))), head: TITLE_PX,
    });
    if (bins.estimated && beside?.hasTiles) {
      const rows = beside.answer.serials.length;
      panels.push({
        key: "beside-tiles", title: `Force per tile, ${beside.name}`, unit: "N", kind: "heat", besideOnly: true,
        height: Math.min(420, Math.max(90, rows * (rows > 24 ? 7 : 14))), head: TITLE_PX,
      });
    }
  } else {
    const height = Math.max(46, Math.min(FORCE_PX, 220 / known.length)); // high if alone
    known.forEach((i, at) => panels.push({
      key: `tile-${i}`, title: tiles[i], ...(isWide(i) ? { unit: "million counts", factor: 1e-6 } : { unit }),
      kind: "series", columns: names(i), ...(bins.estimated && { group: "tiles" }), force: true, zero: bins.estimated, height, head: at ? 7 : 18, tile: i,
    }));
  }
  for (const [axis, title] of [["x", "COP forward"], ["y", "COP left"]]) {
    if (!bins.estimated || !isVariable(bins, `cop_${axis}_m`)) continue;
    panels.push({
      key: `cop-${axis}`, title, unit: "mm", factor: 1e3, kind: "series",
      columns: [`cop_${axis}_m_min`, `cop_${axis}_m_max`], band: [`cop_${axis}_low_m_min`, `cop_${axis}_high_m_max`], least: 2,
      height: PLACE_PX, head: TITLE_PX, ...unmeasured(bins, axis === "x" ? "y" : "x"),
    });
  }
  if (bins.estimated && bins.has("angle_rad_min")) {
    panels.push({
      key: "angle", title: "Foot angle", unit: "°", factor: 180 / Math.PI, kind: "series",
      columns: ["angle_rad_min", "angle_rad_max"], height: PLACE_PX, head: TITLE_PX,
    });
  }
  return panels;
}

/** Return a note if a coordinate of the COP is not measured: across a single row of tiles. */
const unmeasured = (bins, axis) => (bins.has(`cop_${axis}_m_max`) ? {} : { note: `${axis} not measured` });

/** Return true if a coordinate changes: on a line of tiles one is constant. */
function isVariable(bins, stem) {
  const found = bins.extremes(`${stem}_min`, `${stem}_max`, 0, bins.count);
  return found !== null && found.high - found.low > 1e-6;
}
