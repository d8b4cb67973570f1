// Form of a calibration: tiles, reference, weights, tolerance.

import { byId, el, setText } from "../common/text.js";
import { plainWeight } from "./guide.js";

const METHODS = {
  weights: {
    hint: "Put the weights on a light, stiff plate on the dome. Add the mass of the plate.",
    weights: "200 g, 500 g, 1 kg, 1.5 kg, 2 kg", within: "1",
  },
  scale: {
    hint: "Zero the scale with the tile on it. Press with a clamp or a stand; a hand is not steady enough.",
    weights: "200 g, 500 g, 1 kg, 1.5 kg, 2 kg", within: "1",
  },
  sensor: {
    hint: "Press with a spindle until the sensor reads the force.",
    weights: "2 N, 5 N, 10 N, 15 N, 20 N", within: "1",
  },
};
const WEIGHT_S = 40; // including loading, settling and unloading

/** Form that starts a calibration. */
export class Setup {
  /** @param {(body: StartWeighing) => void} onStart */
  constructor(onStart) {
    this.form = byId("setup", HTMLFormElement);
    this.weights = byId("weights", HTMLInputElement);
    this.within = byId("within", HTMLInputElement);
    /** @type {string[]} */
    this.order = []; // selected tiles
    this.shown = "";
    this.filled = ""; // session of the calibration that the form shows
    /** @type {StartWeighing["method"]} */
    this.method = "weights";
    this.useMethod();
    this.form.addEventListener("submit", (event) => {
      event.preventDefault();
      onStart(this.body());
    });
    this.form.addEventListener("input", () => this.drawTexts());
    for (const radio of this.form.querySelectorAll("[name=method]")) {
      radio.addEventListener("change", () => {
        this.method = /** @type {StartWeighing["method"]} */ (/** @type {HTMLInputElement} */ (radio).value);
        this.useMethod();
      });
    }
  }

  /** Show the tiles of a node. @param {NodeView} node */
  update(node) {
    const serials = node.tiles.filter((tile) => !tile.reference).map((tile) => tile.serial);
    const key = [node.node, ...serials].join("\n");
    if (key === this.shown) return;
    this.shown = key;
    this.order = serials;
    byId("tiles").replaceChildren(...serials.map((serial) => this.tileBox(serial)));
    this.drawTexts();
  }

  /** Fill in tiles, method, weights and tolerance of a calibration: this page may be younger than it. @param {WeighingView} weighing */
  fill({ session_id: id, tiles, weights, method }) {
    if (id === this.filled) return;
    this.filled = id;
    this.order = tiles.map(({ serial }) => serial);
    for (const box of byId("tiles").querySelectorAll("input")) box.checked = this.order.includes(box.value);
    for (const radio of /** @type {NodeListOf<HTMLInputElement>} */ (this.form.querySelectorAll("[name=method]"))) radio.checked = radio.value === method;
    this.method = method;
    this.useMethod();
    this.weights.value = weights.map(plainWeight).join(", ");
    this.within.value = /\+-([\d.]+) ?%/.exec(weights[0])?.[1] ?? this.within.value;
    this.drawTexts();
  }

  /** Make the checkbox of a tile. @param {string} serial */
  tileBox(serial) {
    const box = el("input", { type: "checkbox", value: serial, checked: "" });
    box.addEventListener("change", () => {
      this.order = this.order.filter((one) => one !== serial);
      if (box.checked) this.order.push(serial);
    });
    return el("label", {}, box, el("span", { text: serial }), el("span", { cls: "order", "data-order": serial }));
  }

  /** Fill in hint and default weights of the selected reference. */
  useMethod() {
    const { hint, weights, within } = METHODS[this.method];
    setText(byId("method-hint"), hint);
    this.weights.value = weights;
    this.within.value = within;
    this.drawTexts();
  }

  /** Weights of the form. */
  get list() {
    return this.weights.value.split(/;|,(?!\d)|[gN%],/i).map((one) => one.trim()).filter(Boolean);
  }

  /** Update order, duration and the start button. */
  drawTexts() {
    for (const label of this.form.querySelectorAll("[data-order]")) {
      const at = this.order.indexOf(/** @type {HTMLElement} */ (label).dataset.order ?? "");
      setText(label, at < 0 || this.order.length < 2 ? "" : `${at + 1}.`);
    }
    const [tiles, weights] = [this.order.length, this.list.length];
    byId("start", HTMLButtonElement).disabled = !tiles || !weights;
    const minutes = Math.max(1, Math.round(tiles * weights * WEIGHT_S / 60));
    setText(byId("time-needed"), tiles ? `${countText(tiles, "tile")}, ${countText(weights, "weight")}${tiles > 1 ? " each" : ""}: about ${countText(minutes, "minute")}` : "Select a tile.");
  }

  /** Return the request body. @returns {StartWeighing} */
  body() {
    const valueOf = (id) => byId(id, HTMLInputElement).value.trim();
    return {
      tiles: this.order, weights: [this.weights.value], within_percent: Number(this.within.value), method: this.method,
      ...(valueOf("reference") ? { reference: valueOf("reference") } : {}), ...(valueOf("name") ? { name: valueOf("name") } : {}),
    };
  }
}

/** Return a count with its noun. @param {number} count @param {string} noun */
const countText = (count, noun) => `${count} ${noun}${count === 1 ? "" : "s"}`;
