// What is calibrated with what: tiles, reference, weights and tolerance.

import { byId, el, setText } from "../common/text.js";

const METHODS = {
  weights: {
    hint: "Put them on a light, stiff plate on the dome. Add the mass of the plate.",
    weights: "200 g, 500 g, 1 kg, 1.5 kg, 2 kg", within: "1",
  },
  scale: {
    hint: "Zero the scale with the tile on it. Press with a clamp or a stand: no hand is steady enough.",
    weights: "200 g, 500 g, 1 kg, 1.5 kg, 2 kg", within: "1",
  },
  sensor: {
    hint: "Press with a spindle until the display shows the force.",
    weights: "2 N, 5 N, 10 N, 15 N, 20 N", within: "1",
  },
};
const WEIGHT_S = 40; // with putting on, settling and taking off

/** The form before a calibration. */
export class Setup {
  /** @param {(body: WeighingPlan) => void} onStart */
  constructor(onStart) {
    this.form = byId("setup", HTMLFormElement);
    this.weights = byId("weights", HTMLInputElement);
    this.within = byId("within", HTMLInputElement);
    /** @type {string[]} */
    this.order = []; // ticked tiles
    this.shown = "";
    this.method = "weights";
    this.useMethod();
    this.form.addEventListener("submit", (event) => {
      event.preventDefault();
      onStart(this.body());
    });
    this.form.addEventListener("input", () => this.write());
    for (const radio of this.form.querySelectorAll("[name=method]")) {
      radio.addEventListener("change", () => {
        this.method = /** @type {HTMLInputElement} */ (radio).value;
        this.useMethod();
      });
    }
  }

  /** Offer the tiles of a node. @param {LiveNode} node */
  take(node) {
    const serials = node.tiles.filter((tile) => !tile.reference).map((tile) => tile.serial);
    const key = [node.node, ...serials].join("\n");
    if (key === this.shown) return;
    this.shown = key;
    this.order = serials;
    byId("tiles").replaceChildren(...serials.map((serial) => this.tile(serial)));
    this.write();
  }

  /** @param {string} serial */
  tile(serial) {
    const box = el("input", { type: "checkbox", value: serial, checked: "" });
    box.addEventListener("change", () => {
      this.order = this.order.filter((one) => one !== serial);
      if (box.checked) this.order.push(serial);
    });
    return el("label", {}, box, el("span", { text: serial }), el("span", { cls: "turn", "data-turn": serial }));
  }

  useMethod() {
    const { hint, weights, within } = METHODS[this.method];
    setText(byId("method-hint"), hint);
    this.weights.value = weights;
    this.within.value = within;
    this.write();
  }

  get list() {
    return this.weights.value.split(/[,;]/).map((one) => one.trim()).filter(Boolean);
  }

  write() {
    for (const turn of this.form.querySelectorAll("[data-turn]")) {
      const at = this.order.indexOf(/** @type {HTMLElement} */ (turn).dataset.turn ?? "");
      setText(turn, at < 0 || this.order.length < 2 ? "" : `${at + 1}.`);
    }
    const [tiles, weights] = [this.order.length, this.list.length];
    byId("start", HTMLButtonElement).disabled = !tiles || !weights;
    const minutes = Math.max(1, Math.round(tiles * weights * WEIGHT_S / 60));
    setText(byId("lasts"), tiles ? `${counted(tiles, "tile")}, ${counted(weights, "weight")}${tiles > 1 ? " each" : ""}: about ${counted(minutes, "minute")}` : "Tick a tile.");
  }

  /** @returns {WeighingPlan} */
  body() {
    const said = (id) => byId(id, HTMLInputElement).value.trim();
    return {
      tiles: this.order, weights: this.list, within_percent: Number(this.within.value), method: this.method,
      ...(said("reference") ? { reference: said("reference") } : {}), ...(said("name") ? { name: said("name") } : {}),
    };
  }
}

/** @param {number} count @param {string} what */
const counted = (count, what) => `${count} ${what}${count === 1 ? "" : "s"}`;
