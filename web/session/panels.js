// Which plots a session has, one above the other: by what is known in it.

const HEAT_FROM = 9; // tiles: more rows of traces than this are not read
const FORCE_PX = 180;
const PLACE_PX = 76;
const TITLE_PX = 19; // above a plot; a tile's name is in its own

/**
 * @typedef {object} Panel
 * @property {string} key
 * @property {string} title
 * @property {string} unit
 * @property {"series" | "heat"} kind
 * @property {[string, string]} [columns] least and greatest
 * @property {[string, string]} [band] an interval around it
 * @property {string} [note] behind the title
 * @property {string} [bound] what it is at least
 * @property {string} [group] panels of a group have one scale
 * @property {number} [factor] from the column's unit to the one shown
 * @property {boolean} [force] stretches in which forces are doubtful are shown over it
 * @property {boolean} [zero] zero is always in sight
 * @property {boolean} [besideOnly] its numbers are of what is beside the session
 * @property {number} height
 * @property {number} head room above it, for its title
 * @property {number} [tile]
 */

/**
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
      band: ["grf_low_n_min", "grf_high_n_max"], bound: "grf_at_least_n_max", force: true, zero: true, height: FORCE_PX, head: TITLE_PX,
    });
  }
  if (bins.estimated && beside?.columns.difference) {
    panels.push({
      key: "difference", title: `Ours less ${beside.name}`, unit: "N", kind: "series", columns: beside.columns.difference,
      besideOnly: true, zero: true, height: PLACE_PX, head: TITLE_PX,
    });
  }
  const [stem, unit] = bins.estimated ? ["force_n", "N"] : ["padc", "counts"];
  const names = (i) => /** @type {[string, string]} */ ([`${stem}_${i}_min`, `${stem}_${i}_max`]);
  // Of a tile that measures the air there is no force; of one that has failed this is to be seen.
  const known = tiles.map((_, i) => i).filter((i) => bins.has(names(i)[1]) || bins.columns[`status_${i}`].some(Boolean));
  if (asHeat ?? tiles.length >= HEAT_FROM) {
    panels.push({
      key: "tiles", title: bins.estimated ? "Force on each tile" : "Raw counts of each tile, fewer under load",
      unit, kind: "heat", force: true, height: Math.min(420, Math.max(90, tiles.length * (tiles.length > 24 ? 7 : 14))), head: TITLE_PX,
    });
    if (bins.estimated && beside?.hasTiles) {
      const rows = beside.answer.serials.length;
      panels.push({
        key: "beside-tiles", title: `Force on each tile, ${beside.name}`, unit: "N", kind: "heat", besideOnly: true,
        height: Math.min(420, Math.max(90, rows * (rows > 24 ? 7 : 14))), head: TITLE_PX,
      });
    }
  } else {
    const height = Math.max(46, Math.min(FORCE_PX, 220 / known.length)); // alone it has room
    known.forEach((i, at) => panels.push({
      key: `tile-${i}`, title: tiles[i], unit, kind: "series", columns: names(i), group: "tiles", force: true,
      zero: bins.estimated, height, head: at ? 7 : 18, tile: i,
    }));
  }
  for (const [axis, title] of [["x", "Centre of pressure, forward"], ["y", "Centre of pressure, to the left"]]) {
    if (!bins.estimated || !moves(bins, `cop_${axis}_m`)) continue;
    panels.push({
      key: `cop-${axis}`, title, unit: "mm", factor: 1e3, kind: "series",
      columns: [`cop_${axis}_m_min`, `cop_${axis}_m_max`], band: [`cop_${axis}_low_m_min`, `cop_${axis}_high_m_max`],
      height: PLACE_PX, head: TITLE_PX, ...unmeasured(bins, axis === "x" ? "y" : "x"),
    });
  }
  if (bins.estimated && bins.has("angle_rad_min")) {
    panels.push({
      key: "angle", title: "Angle of the foot", unit: "°", factor: 180 / Math.PI, kind: "series",
      columns: ["angle_rad_min", "angle_rad_max"], height: PLACE_PX, head: TITLE_PX,
    });
  }
  return panels;
}

/** A row of tiles does not measure the centre of pressure across it. */
const unmeasured = (bins, axis) => (bins.has(`cop_${axis}_m_max`) ? {} : { note: `COP ${axis} not measured: tiles in one row` });

/** On a line of tiles one coordinate is always the same: that is no plot. */
function moves(bins, stem) {
  const found = bins.extremes(`${stem}_min`, `${stem}_max`, 0, bins.count);
  return found !== null && found.high - found.low > 1e-6;
}
