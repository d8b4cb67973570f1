// Why a warning is there and what follows from it, in two sentences; by what the warning begins with.

/** @type {[begins: RegExp, why: string][]} */
const WHY = [
  [/^Tile missing|does not answer/, "The chip in a tile gives no readings, so what it bears is not known. The other tiles go on, and their sum is what the force is at least; look at the tile's plug and cable."],
  [/^A tile repeats one reading/, "Readings of a live chip differ a little each time, and these do not. The chip hangs, so what it last said is not taken for a force."],
  [/^A tile reads no further/, "Its readings stand still where they should rise with the load. Something holds the dome or the chip is at its end, so its force is that or more."],
  [/^A tile reads too little/, "Without a load the pressure should be that of the last tare, and it is less. The dome has leaked or the tile has another temperature, so what it says now is off by some newtons."],
  [/^After a load/, "The tile was beyond what it can tell, and the rubber keeps some of that load in mind. How much is not known, so the band around the force is wider until it has faded."],
  [/^Above the 115/, "The chip's maker promises its accuracy up to 115 kPa. The calibration goes further, so the force is known, but the part is loaded beyond its data sheet."],
  [/^Below the calibrated/, "The pressure is lower than any that was calibrated. Mud may suck at the foot, or the zero is old: lift the foot and press Tare."],
  [/out of the chip's range/, "The chip measures 50 to 115 kPa of absolute pressure, and this is beyond. Its readings there are shown, but the maker promises nothing for them."],
  [/^Bus fault/, "The wires between the node and the tiles are held or disturbed. Frames are incomplete until that ends; plugs, cable and supply are the usual causes."],
  [/^The node is late/, "The computer on the robot could not ask the tiles in time. Some frames are not sampled, and the others have true times; less other work on it helps."],
  [/^No calibration/, "Pressure becomes force only by what was measured of each tile on a bench. Without that pressures are true, and newtons are not made up."],
  [/^Scale assumed/, "Shape and course of the calibration are measured, its newtons are taken from a typical tile. Compare forces with each other, not with a scale."],
  [/^The models are being compiled/, "The server's models become machine code when it first runs on a machine, which takes most of a minute. Nothing is lost by that: what is recorded meanwhile has its forces when it is sealed."],
  [/^Not tared|^Tare lost/, "The zero of each tile is not known, since pressure of the air and temperature change it. Lift the foot off the ground and press Tare."],
  [/^Tare/, "The zero was taken a while ago or under other conditions, and has moved since. Forces may be off by that; lift the foot and press Tare."],
  [/^Lost/, "These frames were taken or should have been, and are gone for good. What is there is true, and a session says where it has such a gap."],
  [/^Nothing is being kept/, "The server cannot write to its disk. The picture goes on, but nothing is recorded until there is room again."],
  [/^Damaged on the server/, "When the server was started some of its files were not as it had written them. The rest is served; what was damaged is left where it is."],
  [/^Clock of the node/, "Nobody has told the node the date since it was switched on. Distances in time are right, dates and comparisons with other instruments may not be."],
];

/** Two sentences, or "". @param {string} text */
export const whyOf = (text) => WHY.find(([begins]) => begins.test(text))?.[1] ?? "";

/** @type {[begins: RegExp, section: string][]} */
const SECTIONS = [
  [/^Tile missing|does not answer/, "it-is-missing"],
  [/^A tile repeats one reading|^A tile reads no further/, "it-stands-still"],
  [/^A tile reads too little|^Below the calibrated|^Not tared|^Tare/, "a-force-in-the-air"],
  [/^Above the 115|^After a load|^Scale assumed|^No calibration/, "too-low"],
  [/out of the chip's range|^Bus fault/, "it-jumps"],
];

/** What to do about a warning of a tile, as an address; "" where it is of no tile. @param {string} text */
export function helpOf(text) {
  const section = SECTIONS.find(([begins]) => begins.test(text))?.[1];
  return section ? `/static/tile-reads-nonsense.html#${section}` : "";
}
