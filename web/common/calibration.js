// Dialog of a node's calibration: current one, available ones, assign, upload. Loaded when opened.

import * as api from "./api.js";
import { unlessRefused } from "./request.js";
import { el, localTime, setText } from "./text.js";

const SHOWN_TILES = 4;

/**
 * Open the dialog for a node.
 * @param {{node: string, tiles: TileView[]}} node
 */
export async function openCalibration(node) {
  const dialog = new CalibrationDialog(node);
  await dialog.run(() => dialog.load());
}

class CalibrationDialog {
  /** @param {{node: string, tiles: TileView[]}} node */
  constructor({ node, tiles }) {
    this.node = node;
    this.loadSerials = tiles.filter((tile) => !tile.reference).map((tile) => tile.serial);
    /** @type {NodeCalibrationView | null} */
    this.used = null;
    this.inUse = el("p", { id: "calibration-used" });
    this.back = el("button", { type: "button", cls: "small requires-operator", id: "calibration-back", text: "Use the node’s calibration" });
    this.back.hidden = true;
    this.list = el("ul", { id: "calibrations", "aria-label": "Calibrations on the server, newest first" });
    this.none = el("p", { text: "None on the server yet. Calibrate with weights, or upload a file from “foottile calibrate”." });
    this.none.hidden = true;
    this.message = el("p", { id: "calibration-said", role: "alert" });
    this.file = el("input", { type: "file", id: "calibration-file", accept: ".json,application/json" });
    const guided = el("a", { id: "calibration-guided", href: `/calibrate?node=${encodeURIComponent(node)}`, text: "Calibrate with weights …" });
    const upload = el("label", { cls: "requires-operator", text: "Upload calibration file " }, this.file);
    this.element = el("dialog", { id: "calibration-dialog", "aria-labelledby": "calibration-title" },
      el("h2", { id: "calibration-title", text: `Calibration of ${node}` }), this.inUse, this.back,
      el("p", { cls: "soft", text: "Applies from the next frame. A running recording keeps its calibration." }),
      this.none, this.list, guided, upload, this.message,
      el("form", { method: "dialog" }, el("p", { cls: "row" }, el("button", { type: "submit", value: "", autofocus: "", text: "Close" }))));
    this.back.addEventListener("click", () => this.run(() => this.unassign()));
    this.file.addEventListener("change", () => this.run(() => this.upload()));
    this.element.addEventListener("close", () => this.element.remove(), { once: true });
    document.body.append(this.element);
    this.element.showModal();
  }

  /** Run an action; show a refusal in the dialog. @param {() => Promise<void>} action */
  async run(action) {
    setText(this.message, "");
    this.element.setAttribute("aria-busy", "true");
    await unlessRefused(action(), ({ message }) => setText(this.message, `Not done: ${message}`))
      .finally(() => this.element.removeAttribute("aria-busy"));
  }

  async load() {
    const [used, available] = await Promise.all([api.calibrationOf(this.node), api.listCalibrations()]);
    this.used = used;
    const { calibration, source, assigned_t_ns: assigned } = used;
    const origin = source === "server" ? `assigned on ${localTime(new Date(assigned / 1e6))}` : "from the node";
    setText(this.inUse, calibration ? `In use: “${calibration.name}”, scale ${calibration.absolute_scale}, ${origin}.`
      : `None in use: ${used.problem ?? "pressures only."}`);
    this.back.hidden = source !== "server";
    this.none.hidden = available.items.length > 0;
    this.list.replaceChildren(...available.items.map((one) => this.row(one)));
  }

  /** @param {CalibrationSummaryView} calibration */
  row(calibration) {
    const isUsed = calibration.id === this.used?.calibration?.id;
    const any = calibration.serials.includes("*");
    const missing = any ? [] : this.loadSerials.filter((serial) => !calibration.serials.includes(serial));
    const facts = [calibration.date, any ? "any tile" : listOf(calibration.serials), `scale ${calibration.absolute_scale}`];
    if (calibration.mounted) facts.push("mounted");
    const fits = missing.length ? `Does not fit: no curve for ${listOf(missing)}` : "Covers all tiles";
    const item = el("li", { "data-id": calibration.id, "data-used": String(isUsed) },
      el("div", {}, el("strong", { text: calibration.name }), el("span", { text: facts.join(", ") }),
        el("span", { cls: missing.length ? "misfit" : "fit", text: fits })));
    if (isUsed) item.append(el("span", { cls: "used", text: "in use" }));
    else if (!missing.length) {
      const assign = el("button", { type: "button", cls: "small requires-operator", text: "Use this", "aria-label": `Use ${calibration.name} for ${this.node}` });
      assign.addEventListener("click", () => this.run(() => this.assign(calibration)));
      item.append(assign);
    }
    return item;
  }

  /** Calibration on display, sent as If-Match: a later assignment is not overwritten. */
  get shown() {
    return this.used?.calibration?.id ?? "none";
  }

  /** @param {CalibrationSummaryView} calibration */
  async assign(calibration) {
    await api.assignCalibration(this.node, calibration.id, this.shown);
    await this.load();
  }

  async unassign() {
    await api.unassignCalibration(this.node, this.shown);
    await this.load();
  }

  async upload() {
    const [file] = this.file.files ?? [];
    if (!file) return;
    try {
      await api.uploadCalibration(file);
    } finally {
      this.file.value = ""; // allows the same file again
    }
    await this.load();
  }
}

/** Return the first serials as text. @param {string[]} serials */
function listOf(serials) {
  const shown = serials.slice(0, SHOWN_TILES).join(", ");
  return serials.length > SHOWN_TILES ? `${shown} and ${serials.length - SHOWN_TILES} more` : shown;
}
