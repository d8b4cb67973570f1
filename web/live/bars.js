// One bar per tile, with min and max of the summarised frames, so that no peak is lost between messages.

import { byId, el, number, plain, setData, setText } from "../common/text.js";
import { Range } from "./range.js";
import { FAULT_STATES, hasFullScale, readTile, unitOf } from "./tile.js";
import { Tracks } from "./tracks.js";

const BELOW_ZERO = 0.1; // room below the zero line, as a share of full scale
const PEAK_HOLD_MS = 1000; // one message lasts 33 ms
const UPRIGHT_MAX = 16; // more tiles: horizontal bars in a compact grid
const UNIT_KEY = "foottile.unit";

const share = (value, scale) => Math.min(0.993, Math.max(0.007, (value / scale + BELOW_ZERO) / (1 + BELOW_ZERO)));

/** Bars of all tiles. */
export class Bars {
  /** @param {() => void} onUnit @param {Range} [range] full scale of the bars */
  constructor(onUnit, range = new Range()) {
    this.list = byId("bars");
    this.tracks = new Tracks();
    this.range = range;
    this.cells = [];
    this.key = "";
    this.tiles = null;
    this.onUnit = onUnit;
    let stored = null;
    try { stored = localStorage.getItem(UNIT_KEY); } catch { /* private window */ }
    this.unit = stored === "kPa" ? "kPa" : "N";
    byId("unit-kpa").addEventListener("click", () => this.choose("kPa"));
    byId("unit-n").addEventListener("click", () => this.choose("N"));
    this.showUnit(this.unit);
    new ResizeObserver(() => this.arrange()).observe(this.list);
  }

  choose(unit) {
    this.unit = unit;
    try { localStorage.setItem(UNIT_KEY, unit); } catch { /* private window */ }
    this.key = ""; // full scales change: rebuild
    this.tiles = null;
    this.showUnit(unit);
    this.onUnit();
  }

  /** Highlight the unit on display: kPa while there are no forces. */
  showUnit(unit) {
    this.shown = unit;
    byId("unit-kpa").setAttribute("aria-pressed", String(unit === "kPa"));
    byId("unit-n").setAttribute("aria-pressed", String(unit === "N"));
  }

  /** Build the cells of the node's tiles, if these have changed. */
  fit(node) {
    if (node.tiles === this.tiles && this.key.startsWith(this.shown)) return;
    this.tiles = node.tiles;
    const key = this.shown + JSON.stringify([node.node, node.tiles]);
    if (key === this.key) return;
    this.key = key;
    this.cells = (node?.tiles ?? []).map((tile) => makeCell(tile, this.shown));
    this.list.replaceChildren(...this.cells.map((cell) => cell.root));
    this.tracks.over(this.cells.map((cell) => cell.track));
    this.arrange();
  }

  arrange() {
    const count = this.cells.length;
    if (!count) return;
    const widthPx = this.list.clientWidth;
    const compact = this.tracks.lying = count > UPRIGHT_MAX;
    let columns;
    if (compact) columns = widthPx >= 440 ? 8 : 4;
    else {
      const rows = Math.ceil((count * 40) / Math.max(widthPx, 1));
      columns = Math.ceil(count / Math.max(rows, 1));
    }
    setData(this.list, "compact", String(compact));
    setData(this.list, "narrow", String(widthPx / columns < 86));
    this.list.style.setProperty("--columns", String(columns));
    this.list.style.setProperty("--rows", String(Math.ceil(count / columns)));
  }

  /** Draw the bars; `writesText`: write their numbers, too. */
  draw(node, frame, nowMs, writesText = true) {
    const unit = hasPressuresOnly(frame) ? "kPa" : this.unit;
    if (unit !== this.shown) this.showUnit(unit);
    this.fit(node);
    this.range.update(node, frame, nowMs);
    this.tracks.draw(this.cells.map((cell, i) => {
      setScale(cell, this.range.of(cell.tile, cell.unit), this.range.automatic);
      const reading = readTile(node, i, frame, this.shown);
      setData(cell.root, "value", plain(reading.value));
      if (writesText) writeCell(cell, reading);
      return barOf(cell, reading, nowMs);
    }));
  }
}

/** Return true while models are compiled: pressures are there, forces are not. */
const hasPressuresOnly = (frame) => Boolean(frame?.gauge_kpa?.some(Number.isFinite)) && !frame.force_n.some(Number.isFinite);

function makeCell(tile, unitChosen) {
  const unit = unitOf(tile, unitChosen);
  const cell = {
    tile, unit, scale: null, peak: null, peakUntilMs: 0,
    text: el("span", { cls: "says" }),
    value: el("span", { cls: "value", text: "–" }),
    sigma: el("span", { cls: "sigma" }),
  };
  cell.text.append(cell.word = el("span"), cell.bound = el("span", { cls: "bound" }));
  cell.track = el("div", { cls: "track" }, cell.text);
  cell.root = el("li", { cls: "tile", "data-serial": tile.serial, "data-state": "waiting", "data-value": "", "data-unit": unit },
    el("span", { cls: "serial", text: tile.serial }),
    el("span", { cls: "scale" }, ...(tile.reference ? [el("span", { cls: "word", text: "unloaded " }), "reference"] : [])),
    cell.track,
    el("span", { cls: "number" }, cell.value, el("span", { cls: "unit", text: ` ${unit}` })),
    cell.sigma);
  if (tile.reference) cell.root.dataset.reference = "true";
  cell.scaleText = cell.root.querySelector(".scale");
  return cell;
}

/** Write the scale of a bar; a tile of unknown range has one only in automatic range. */
function setScale(cell, scale, automatic) {
  if (cell.scale === scale && cell.automatic === automatic) return;
  cell.scale = scale;
  cell.automatic = automatic;
  if (cell.tile.reference) return;
  const isKnown = automatic || hasFullScale(cell.tile, cell.unit);
  cell.scaleText.replaceChildren(...(isKnown
    ? [el("span", { cls: "word", text: "scale " }), `0-${number(scale, scale % 1 ? 1 : 0)}`, el("span", { cls: "unit", text: ` ${cell.unit}` })] : []));
}

/** Write state, value and uncertainty of a tile. */
function writeCell(cell, reading) {
  setData(cell.root, "state", reading.state);
  setData(cell.root, "fault", String(FAULT_STATES.has(reading.state)));
  setText(cell.word, reading.text);
  setText(cell.bound, reading.bound ? `, ≥ ${reading.bound} ${cell.unit}` : "");
  const half = 1.96 * (reading.sigma ?? NaN);
  const decimals = half < 0.05 ? 2 : 1; // of a quiet chip
  setText(cell.value, reading.bound ? `≥ ${reading.bound}` : number(reading.value, Math.abs(reading.value) < 99.95 ? decimals : 0));
  setText(cell.sigma, reading.sigma === null ? "" : `± ${number(half, decimals)}`);
}

/** Return the bar of a reading; null: none. @returns {import("./tracks.js").Bar | null} */
function barOf(cell, reading, nowMs) {
  const at = (value) => share(value, cell.scale);
  const zero = at(0);
  if (reading.value === null) {
    cell.peak = null;
    return reading.state === "saturated" ? { zero } : null;
  }
  const bar = { zero, value: at(reading.value) };
  if (reading.low === null || reading.high === null) return bar;
  if (cell.peak === null || reading.high >= cell.peak || nowMs > cell.peakUntilMs) {
    cell.peak = reading.high;
    cell.peakUntilMs = nowMs + PEAK_HOLD_MS;
  }
  return { ...bar, low: at(reading.low), high: at(reading.high), peak: at(cell.peak) };
}
