// Clock page as squares: layout and code, as docs/video.md has them. Pure.

export const TICK_MS = 23;
export const UNITS = { across: 32, down: 18 };
export const UNKNOWN_MS = 63;
const CELL = 2; // units
const CELLS_AT = { x: 9, y: 1 };
const CELLS_PER_ROW = 7;
/** ArUco tags 46 to 49 of the dictionary 4x4_50; 1: black. */
const TAGS = [
  { x: 1, y: 1, rows: ["111111", "111011", "100101", "111001", "100001", "111111"] },
  { x: 25, y: 1, rows: ["111111", "110111", "101001", "110011", "110111", "111111"] },
  { x: 25, y: 11, rows: ["111111", "110101", "111111", "111011", "100011", "111111"] },
  { x: 1, y: 11, rows: ["111111", "110101", "111111", "111101", "111001", "111111"] },
];

const bits = (value, count) => value.toString(2).padStart(count, "0");

/** Return the cells of an instant, row by row, "1" for black. @param {number} tMs server's UTC @param {number} boundMs @param {number} refreshMs */
export function cellsOf(tMs, boundMs, refreshMs) {
  const n = Math.floor(tMs / TICK_MS) % 2 ** 32;
  const check = (((n >>> 6) * 64 + boundMs) * 64 + refreshMs + 1) % 4093;
  return bits(boundMs, 6) + bits(refreshMs, 6) + bits(check, 12) + bits((n ^ (n >>> 1)) >>> 0, 32);
}

/** Draw all on a context whose unit is one of the page's. @param {CanvasRenderingContext2D} context @param {string} cells */
export function drawCode(context, cells) {
  context.fillStyle = "#fff";
  context.fillRect(0, 0, UNITS.across, UNITS.down);
  context.fillStyle = "#000";
  for (const { x, y, rows } of TAGS) {
    rows.forEach((row, j) => [...row].forEach((bit, i) => { if (bit === "1") context.fillRect(x + i, y + j, 1, 1); }));
  }
  [...cells].forEach((bit, i) => {
    if (bit === "1") context.fillRect(CELLS_AT.x + CELL * (i % CELLS_PER_ROW), CELLS_AT.y + CELL * Math.floor(i / CELLS_PER_ROW), CELL, CELL);
  });
}

const DRIFT = 1e-4; // of this device's clock against the server's
const STEP_MS = 1; // of clocks of browsers

/** Offset of the server's clock, from the shortest round trip. */
export class Offset {
  constructor() { this.best = null; }

  /** Note an answer: sent and received by this page's clock, answered by the server's. */
  note(sentMs, serverMs, receivedMs) {
    const halfMs = (receivedMs - sentMs + STEP_MS) / 2;
    const aheadMs = serverMs - (sentMs + receivedMs) / 2;
    const boundMs = this.boundMs(receivedMs);
    // Intervals that do not overlap: one of the clocks was set, or slept.
    if (halfMs < boundMs || Math.abs(aheadMs - this.best.aheadMs) > halfMs + boundMs) this.best = { aheadMs, halfMs, atMs: receivedMs };
  }

  boundMs(nowMs) { return this.best ? this.best.halfMs + DRIFT * (nowMs - this.best.atMs) : Infinity; }
}

/** Return a duration as the code states it: in ms, rounded up, or unknown. */
export const statedMs = (ms) => (ms > 0 && Math.ceil(ms) < UNKNOWN_MS ? Math.ceil(ms) : UNKNOWN_MS);
