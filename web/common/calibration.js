// The dialog of a node's calibration: which one is in use, which there are, and another one chosen or
// uploaded. Loaded when it is opened.

import * as api from "./api.js";
import { el, localTime, setText } from "./text.js";

const SHOWN_TILES = 4;

/**
 * Open it for a node as the server described it last.
 * @param {{node: string, tiles: Tile[]}} node
 */
export async function openCalibration(node) {
  const dialog = new CalibrationDialog(node);
  await dialog.doing(() => dialog.load());
}

class CalibrationDialog {
  /** @param {{node: string, tiles: Tile[]}} node */
  constructor({ node, tiles }) {
    this.node = node;
    this.bearing = tiles.filter((tile) => !tile.reference).map((tile) => tile.serial);
    /** @type {NodeCalibration | null} */
    this.used = null;
    this.inUse = el("p", { id: "calibration-used" });
    this.back = el("button", { type: "button", cls: "small presses", id: "calibration-back", text: "Use the node’s own again" });
    this.back.hidden = true;
    this.list = el("ul", { id: "calibrations", "aria-label": "Calibrations that the server keeps, newest first" });
    this.none = el("p", { text: "The server keeps none yet. Calibrate with weights, or upload a file that “foottile calibrate” has written." });
    this.none.hidden = true;
    this.said = el("p", { id: "calibration-said", role: "alert" });
    this.file = el("input", { type: "file", id: "calibration-file", accept: ".json,application/json" });
    const guided = el("a", { id: "calibration-guided", href: `/calibrate?node=${encodeURIComponent(node)}`, text: "Calibrate with weights …" });
    const upload = el("label", { cls: "presses", text: "Upload a calibration file " }, this.file);
    this.element = el("dialog", { id: "calibration-dialog", "aria-labelledby": "calibration-title" },
      el("h2", { id: "calibration-title", text: `Calibration of ${node}` }), this.inUse, this.back,
      el("p", { cls: "soft", text: "A choice counts from the next frame on; what is being recorded keeps what it began with." }),
      this.none, this.list, guided, upload, this.said,
      el("form", { method: "dialog" }, el("p", { cls: "row" }, el("button", { type: "submit", value: "", autofocus: "", text: "Close" }))));
    this.back.addEventListener("click", () => this.doing(() => this.takeBack()));
    this.file.addEventListener("change", () => this.doing(() => this.upload()));
    this.element.addEventListener("close", () => this.element.remove(), { once: true });
    document.body.append(this.element);
    this.element.showModal();
  }

  /** Do something; a refusal is said here, in the server's words. @param {() => Promise<void>} what */
  async doing(what) {
    setText(this.said, "");
    this.element.setAttribute("aria-busy", "true");
    try {
      await what();
    } catch (error) {
      if (!(error instanceof api.Refusal)) throw error;
      setText(this.said, `Not done: ${error.message}`);
    } finally {
      this.element.removeAttribute("aria-busy");
    }
  }

  async load() {
    const [used, kept] = await Promise.all([api.calibrationOf(this.node), api.listCalibrations()]);
    this.used = used;
    const { calibration, source, assigned_t_ns: assigned } = used;
    const whose = source === "server" ? `chosen here on ${localTime(new Date(assigned / 1e6))}` : "said by the node itself";
    setText(this.inUse, calibration ? `In use: “${calibration.name}”, scale ${calibration.absolute_scale}, ${whose}.`
      : `None is in use: ${used.problem ?? "pressures only, no newtons."}`);
    this.back.hidden = source !== "server";
    this.none.hidden = kept.items.length > 0;
    this.list.replaceChildren(...kept.items.map((one) => this.row(one)));
  }

  /** @param {Kept} kept */
  row(kept) {
    const isUsed = kept.id === this.used?.calibration?.id;
    const any = kept.serials.includes("*");
    const lacking = any ? [] : this.bearing.filter((serial) => !kept.serials.includes(serial));
    const facts = [kept.date, any ? "any tile" : some(kept.serials), `scale ${kept.absolute_scale}`];
    if (kept.mounted) facts.push("as mounted");
    const fits = lacking.length ? `Does not fit: no curve of ${some(lacking)}` : "Has a curve of each tile";
    const item = el("li", { "data-id": kept.id, "data-used": String(isUsed) },
      el("div", {}, el("strong", { text: kept.name }), el("span", { text: facts.join(", ") }),
        el("span", { cls: lacking.length ? "misfit" : "fit", text: fits })));
    if (isUsed) item.append(el("span", { cls: "used", text: "in use" }));
    else if (!lacking.length) {
      const assign = el("button", { type: "button", cls: "small presses", text: "Use this", "aria-label": `Use ${kept.name} for ${this.node}` });
      assign.addEventListener("click", () => this.doing(() => this.assign(kept)));
      item.append(assign);
    }
    return item;
  }

  /** What is in use as this dialog shows it: another choice by now is not overwritten. */
  get shown() {
    return this.used?.calibration?.id ?? "none";
  }

  /** @param {Kept} kept */
  async assign(kept) {
    await api.assignCalibration(this.node, kept.id, this.shown);
    await this.load();
  }

  async takeBack() {
    await api.takeBackCalibration(this.node, this.shown);
    await this.load();
  }

  async upload() {
    const [file] = this.file.files ?? [];
    if (!file) return;
    try {
      await api.uploadCalibration(file);
    } finally {
      this.file.value = ""; // the same one may be tried again
    }
    await this.load();
  }
}

/** Serials, the first of many. @param {string[]} serials */
function some(serials) {
  const shown = serials.slice(0, SHOWN_TILES).join(", ");
  return serials.length > SHOWN_TILES ? `${shown} and ${serials.length - SHOWN_TILES} more` : shown;
}
