// Reason and remedy of each warning, by its key.

/** @type {Record<string, {why: string, section?: string}>} */
const WARNINGS = {
  tile_missing: { section: "it-is-missing",
    why: "The chip of a tile gives no readings, so its load is unknown. The sum of the other tiles is a lower bound; check the tile's plug and cable." },
  stuck: { section: "it-stands-still",
    why: "Readings of a working chip vary a little, and these are all equal. The chip hangs, so its readings are not used." },
  clipped: { section: "it-stands-still",
    why: "Readings stop below the end of the range while the load rises. The dome is blocked or the chip has reached its end, so the force is a lower bound." },
  baseline_lost: { section: "a-force-in-the-air",
    why: "The unloaded pressure is below that of the last tare. The dome leaks or the tile's temperature has changed, so forces are off by a few newtons." },
  after_saturation: { section: "too-low",
    why: "The rubber remembers each load, and a saturated tile or frames not sampled hid one: the 95 % interval is wider until that fades. If it recurs, reduce the load on the foot or on the node's computer." },
  history_unknown: { section: "too-low",
    why: "The rubber remembers each load, and the node began to read under one: the 95 % interval is wider until that fades. Lift the foot once." },
  over_rated: { section: "too-low",
    why: "The data sheet specifies accuracy up to the end of the chip's range only. The calibration covers this pressure, so the force is known, but the chip is overloaded." },
  below_range: { section: "a-force-in-the-air",
    why: "The pressure is below the calibrated range. Mud may pull at the foot, or the zero is old: lift the foot and press Tare." },
  over_range: { section: "it-jumps",
    why: "This reading is outside the range of the tile's chip. Such readings are shown, but their accuracy is not specified." },
  bus_fault: { section: "it-jumps",
    why: "The bus between node and tiles is held or disturbed. Frames are incomplete until the fault ends; check plugs, cable and supply." },
  overrun: {
    why: "The node's computer could not read all tiles in time. Some frames are not sampled, all others have correct times; reduce other load on it." },
  no_calibration: { section: "too-low",
    why: "Force needs a calibration of each tile. Without one, pressures are correct and no newtons are shown." },
  scale_assumed: { section: "too-low",
    why: "The shape of the calibration is measured, its newtons are those of a typical tile. Compare forces with each other, not with an instrument." },
  compiling: {
    why: "The server compiles its models at the first start on a machine, which takes up to a minute. Recordings are complete: their forces are computed when they are sealed." },
  tare: { section: "a-force-in-the-air",
    why: "The zero of each tile depends on ambient pressure and temperature. Lift the foot and press Tare." },
  tare_doubt: { section: "a-force-in-the-air",
    why: "The zero is old or was taken under other conditions, so forces may be off. Lift the foot and press Tare." },
  lost: {
    why: "These frames are lost for good. All others are correct, and a session shows where frames are missing." },
  storage: {
    why: "The server cannot write to its disk. The display continues, but nothing is recorded until there is space again." },
  damaged: {
    why: "Some files on the server's disk cannot be used: they changed since they were written, or another version wrote them. They are left in place, all others are served." },
  clock: {
    why: "The node's clock has not been set since it was switched on. Time differences are correct, dates and comparisons with other instruments may be wrong." },
};

/** Return reason and remedy, two sentences, or "". @param {string} key */
export const whyOf = (key) => WARNINGS[key]?.why ?? "";

/** Return the address of the help on a warning, or "". @param {string} key */
export function helpOf(key) {
  const section = WARNINGS[key]?.section;
  return section ? `/static/tile-reads-nonsense.html#${section}` : "";
}
