// Markers of a session: list, add at the cursor, rename, move, remove.

import * as api from "../common/api.js";
import { notice, quietly, showRefusal } from "../common/notices.js";
import { unlessRefused } from "../common/request.js";
import { byId, el, setText } from "../common/text.js";
import { timeText } from "./overlay.js";

/** Markers on the time axis of a session. */
export class Markers {
  /**
   * @param {string} id
   * @param {object} on
   * @param {(timeS: number) => void} on.go
   * @param {() => void} on.changed
   * @param {() => number | null} on.cursor
   */
  constructor(id, on) {
    this.id = id;
    this.on = on;
    this.placed = [];
    this.version = 0;
    this.dragged = null;
  }

  /** @param {(tNs: number, ofServer: boolean) => number | null} offset server's UTC minus the node's */
  show(events, beginNs, offset) {
    this.beginNs = beginNs;
    this.offset = offset;
    this.unmeasured = false;
    this.placed = [];
    for (const event of events) this.place(event);
    this.draw();
  }

  place(event) {
    const offset = this.offset(event.t_ns, true);
    if (offset === null) this.unmeasured = true;
    this.placed = this.placed.filter((marker) => marker.id !== event.id);
    this.placed.push({ id: event.id, label: event.label, revision: event.revision, timeS: (event.t_ns - (offset ?? 0) - this.beginNs) * 1e-9 });
    this.placed.sort((a, b) => a.timeS - b.timeS);
  }

  /** Return the server's time, ns. Rounding costs up to 0.25 us. */
  tNsOf(timeS) {
    const tNs = this.beginNs + timeS * 1e9;
    return Math.round(tNs + (this.offset(tNs, false) ?? 0));
  }

  async add(timeS) {
    const field = byId("new-marker-label", HTMLInputElement);
    const label = field.value.trim() || "marker";
    const event = await api.addMarker(this.id, { label, t_ns: this.tNsOf(timeS) });
    field.value = "";
    this.place(event);
    this.draw();
    notice(`Marker “${label}” set.`);
  }

  /** @param {{label?: string, timeS?: number}} to */
  async change(marker, to) {
    const { label, timeS } = to;
    const changes = {};
    if (label && label !== marker.label) changes.label = label;
    if (Number.isFinite(timeS) && timeS !== marker.timeS) changes.t_ns = this.tNsOf(timeS);
    if (!Object.keys(changes).length) return;
    await this.orReload(async () => this.place(await api.changeMarker(this.id, marker.id, changes, marker.revision)));
    this.draw();
  }

  async remove(marker) {
    await this.orReload(async () => {
      await api.removeMarker(this.id, marker.id, marker.revision);
      this.placed = this.placed.filter(({ id }) => id !== marker.id);
      notice(`Removed marker “${marker.label}”.`);
    });
    this.draw();
  }

  /** Run a change; if refused, show the reason and load the markers again. */
  async orReload(doing) {
    try {
      await doing();
    } catch (error) {
      showRefusal(error);
      const events = await unlessRefused(api.listMarkers(this.id));
      if (events) this.show(events.items, this.beginNs, this.offset);
    }
  }

  /** Start dragging a marker; return false if there is none. */
  grab(id) {
    const marker = this.placed.find((one) => one.id === id);
    this.dragged = marker ? { marker, fromS: marker.timeS } : null;
    return Boolean(marker);
  }

  drag(timeS) {
    this.dragged.marker.timeS = timeS;
    this.draw();
  }

  drop(timeS) {
    const { marker, fromS } = this.dragged;
    this.dragged = null;
    marker.timeS = fromS;
    if (timeS !== null && timeS !== fromS) quietly(() => this.change(marker, { timeS }));
    else this.draw();
  }

  edit(marker) {
    const dialog = byId("marker-dialog", HTMLDialogElement);
    const [label, time] = ["marker-label", "marker-time"].map((id) => byId(id, HTMLInputElement));
    label.value = marker.label;
    const shown = time.value = marker.timeS.toFixed(6);
    const cursorS = this.on.cursor();
    byId("marker-to-cursor", HTMLButtonElement).disabled = cursorS === null;
    byId("marker-to-cursor").onclick = () => { time.value = cursorS.toFixed(6); };
    dialog.returnValue = "";
    dialog.addEventListener("close", () => quietly(async () => {
      if (dialog.returnValue === "remove") await this.remove(marker);
      if (dialog.returnValue !== "ok") return;
      const timeS = time.value === shown ? marker.timeS : Number.parseFloat(time.value.replace(",", "."));
      await this.change(marker, { label: label.value.trim(), timeS });
    }), { once: true });
    dialog.showModal();
  }

  draw() {
    this.version += 1;
    byId("markers-list").replaceChildren(...this.placed.map((marker) => {
      const go = el("button", { type: "button", cls: "small", text: `${timeText(marker.timeS, 0.01)}  ${marker.label}` });
      go.addEventListener("click", () => this.on.go(marker.timeS));
      const edit = el("button", { type: "button", cls: "small requires-operator", text: "✎", title: "Rename, move or remove", "aria-label": `Edit marker ${marker.label}` });
      edit.addEventListener("click", () => this.edit(marker));
      return el("li", { "data-time-s": marker.timeS.toFixed(6) }, go, edit);
    }));
    setText(byId("markers-warning"), this.unmeasured && this.placed.length
      ? "Clock offset not measured: marker times are as accurate as the node's clock." : "");
    this.on.changed();
  }
}
