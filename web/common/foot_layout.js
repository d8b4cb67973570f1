// Positions of tiles in a picture: from the side (line of tiles) or from above (plan). Pure.

const GRID_FROM_M = 0.005; // tiles spread wider than this in y are a grid
const SAME_PLACE_M = 1e-6; // tiles that differ by less are in one row

/** @typedef {{x: number, y: number}} Point in pixels */

const range = (values) => [Math.min(...values), Math.max(...values)];

/** Return true if the tiles spread in y: shown from above. @param {TileView[]} tiles */
export function isPlan(tiles) {
  const [least, most] = range(tiles.map((tile) => tile.y_m));
  return most - least > GRID_FROM_M;
}

/** Return the least distance of two tiles: sets the size of the domes. */
function spacing(tiles, up) {
  let least = Infinity;
  tiles.forEach((a, i) => tiles.slice(0, i).forEach((b) => {
    const distance = Math.hypot(a.x_m - b.x_m, up(a) - up(b));
    if (distance > 1e-6) least = Math.min(least, distance);
  }));
  return Number.isFinite(least) ? least : 0.014;
}

/** Return true if squares as wide as the pitch do not overlap. */
export function isGrid(tiles) {
  const pitch = spacing(tiles, (tile) => tile.y_m);
  const beside = (a, b) => Math.max(Math.abs(a.x_m - b.x_m), Math.abs(a.y_m - b.y_m)) > 0.98 * pitch;
  return isPlan(tiles) && tiles.every((a, i) => tiles.slice(0, i).every((b) => beside(a, b)));
}

/** Return the coordinate that all places share, or null. @param {number[]} placesM @returns {number | null} */
function commonPlace(placesM) {
  const [least, most] = range(placesM);
  return most - least <= SAME_PLACE_M ? least : null;
}

/** Layout of a foot in a box. */
export class FootLayout {
  /**
   * @param {TileView[]} tiles
   * @param {object} box
   * @param {number} box.widthPx
   * @param {number} box.heightPx
   * @param {number} box.roomPx height that the foot leaves free
   * @param {number} [box.basePx] height of the sole over the lower edge, side view
   * @param {boolean} [box.turns] a servo rotates it about the ankle
   * @param {boolean} [box.toesUp] plan view: forward is up, not right
   * @param {number} [box.margin] around the outermost tiles, in pitches
   */
  constructor(tiles, { widthPx, heightPx, roomPx, basePx = 74, turns = false, toesUp = false, margin: around = 0.9 }) {
    this.plan = isPlan(tiles);
    this.toesUp = this.plan && toesUp;
    const up = (tile) => (this.plan ? tile.y_m : tile.z_m);
    const [back, front] = range(tiles.map((tile) => tile.x_m));
    const [low, high] = range(tiles.map(up));
    /** Pitch of the tiles, m. */
    this.pitch = spacing(tiles, up);
    /** Length from rear to front tile, m. */
    this.span = front - back;
    const margin = around * this.pitch;
    // Rolling by 10 degrees about the ankle must stay in the picture.
    const roll = !this.plan && turns ? Math.abs(low) * Math.sin(0.17) : 0;
    const spanX = front - back + 2 * (margin + roll);
    const spanUp = high - low + 2 * margin;
    const [across, down] = this.toesUp ? [spanUp, spanX] : [spanX, spanUp];
    /** Pixels per metre. */
    this.scale = Math.min(widthPx / across, (heightPx - roomPx) / down, this.plan ? 4000 : 5000);
    this.widthPx = widthPx;
    this.heightPx = heightPx;
    this.middle = { x: (back + front) / 2, up: this.plan ? (low + high) / 2 : low };
    this.baseline = this.plan ? heightPx / 2 : heightPx - basePx;
    this.radiusPx = Math.min(0.44 * this.pitch * this.scale, 30);
    this.points = tiles.map((tile) => this.at(tile.x_m, up(tile)));
    const loaded = tiles.filter((tile) => !tile.reference);
    /** Common x and y of the loaded tiles, in metres; null: tiles differ, so the centre of pressure is measured along that axis. */
    this.row = { x: commonPlace(loaded.map((tile) => tile.x_m)), y: commonPlace(loaded.map((tile) => tile.y_m)) };
    /** Tiles from heel to toe. */
    this.order = tiles.map((_, i) => i).sort((a, b) => tiles[a].x_m - tiles[b].x_m);
  }

  /**
   * Return the pixel of a position in the foot's frame; `upM` is y (left) in plan view, z from the side.
   * @returns {Point}
   */
  at(xM, upM) {
    const [forward, up] = [(xM - this.middle.x) * this.scale, (upM - this.middle.up) * this.scale];
    if (this.toesUp) return { x: this.widthPx / 2 - up, y: this.baseline - forward };
    return { x: this.widthPx / 2 + forward, y: this.baseline - up };
  }

  /**
   * Return the position in metres at which a centre of pressure is drawn: a coordinate that is not measured is that of the row.
   * @param {number | null | undefined} xM
   * @param {number | null | undefined} yM
   * @returns {{x: number, y: number} | null} null: no centre of pressure
   */
  copPlace(xM, yM) {
    if (!Number.isFinite(xM) && !Number.isFinite(yM)) return null;
    const [x, y] = [xM ?? this.row.x, yM ?? this.row.y];
    return x === null || y === null ? null : { x, y };
  }

  /** Return the sole and the leg above it, as an SVG path. */
  sole() {
    const first = this.points[this.order[0]];
    const last = this.points[this.order.at(-1)];
    const edge = 0.6 * this.pitch * this.scale;
    const line = this.order.map((i) => `L${this.points[i].x} ${this.points[i].y}`).join("");
    // Narrows to the leg, which leaves the picture at the top.
    const knee = Math.min(first.y, last.y) - 0.45 * this.heightPx;
    const middle = (first.x + last.x) / 2;
    const leg = 0.3 * (last.x - first.x) + 14;
    const top = -2 * this.heightPx;
    return `M${middle - leg} ${top}V${knee}L${first.x - edge} ${first.y - edge}L${first.x - edge} ${first.y}${line}`
      + `L${last.x + edge} ${last.y}L${last.x + edge} ${last.y - edge}L${middle + leg} ${knee}V${top}`;
  }

  /** Return the unit normal into the foot at tile i. */
  inward(i) {
    const k = this.order.indexOf(i);
    const a = this.points[this.order[Math.max(0, k - 1)]];
    const b = this.points[this.order[Math.min(this.order.length - 1, k + 1)]];
    const length = Math.hypot(b.x - a.x, b.y - a.y);
    return length ? { x: (b.y - a.y) / length, y: -(b.x - a.x) / length } : { x: 0, y: -1 };
  }

  /** Return the height of the line of tiles at x. */
  lineAt(xPx) {
    const line = this.order.map((i) => this.points[i]);
    if (line.length === 1) return line[0].y;
    let k = line.findIndex((point) => point.x >= xPx);
    k = k < 0 ? line.length - 1 : Math.max(1, k);
    const [a, b] = [line[k - 1], line[k]];
    return b.x === a.x ? a.y : a.y + ((xPx - a.x) / (b.x - a.x)) * (b.y - a.y);
  }
}
