// Marks of a session on its time axis: listed to go to, set at the cursor, renamed, moved and removed.

import * as api from "../common/api.js";
import { notice, quietly, showRefusal } from "../common/notices.js";
import { unlessRefused } from "../common/request.js";
import { byId, el, setText } from "../common/text.js";
import { timeWords } from "./overlay.js";

export class Marks {
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
    this.placed = this.placed.filter((mark) => mark.id !== event.id);
    this.placed.push({ id: event.id, label: event.label, said: event.said, timeS: (event.t_ns - (offset ?? 0) - this.beginNs) * 1e-9 });
    this.placed.sort((a, b) => a.timeS - b.timeS);
  }

  /** The server's instant. A rounded number of this size is right to a quarter of a microsecond. */
  tNsOf(timeS) {
    const tNs = this.beginNs + timeS * 1e9;
    return Math.round(tNs + (this.offset(tNs, false) ?? 0));
  }

  async add(timeS) {
    const field = byId("new-mark-label", HTMLInputElement);
    const label = field.value.trim() || "mark";
    const event = await api.markEvent(this.id, { label, t_ns: this.tNsOf(timeS) });
    field.value = "";
    this.place(event);
    this.draw();
    notice(`Marked “${label}”.`);
  }

  /** @param {{label?: string, timeS?: number}} to */
  async change(mark, to) {
    const { label, timeS } = to;
    const changes = {};
    if (label && label !== mark.label) changes.label = label;
    if (Number.isFinite(timeS) && timeS !== mark.timeS) changes.t_ns = this.tNsOf(timeS);
    if (!Object.keys(changes).length) return;
    await this.orReload(async () => this.place(await api.changeMark(this.id, mark.id, changes, mark.said)));
    this.draw();
  }

  async remove(mark) {
    await this.orReload(async () => {
      await api.removeMark(this.id, mark.id, mark.said);
      this.placed = this.placed.filter(({ id }) => id !== mark.id);
      notice(`Removed the mark “${mark.label}”.`);
    });
    this.draw();
  }

  /** What is refused is told; and then it is shown as it is by now. */
  async orReload(doing) {
    try {
      await doing();
    } catch (error) {
      showRefusal(error);
      const events = await unlessRefused(api.listEvents(this.id));
      if (events) this.show(events.items, this.beginNs, this.offset);
    }
  }

  /** A flag is taken hold of, moved, and let go; `null`: never mind. */
  grab(id) {
    const mark = this.placed.find((one) => one.id === id);
    this.dragged = mark ? { mark, fromS: mark.timeS } : null;
    return Boolean(mark);
  }

  drag(timeS) {
    this.dragged.mark.timeS = timeS;
    this.draw();
  }

  drop(timeS) {
    const { mark, fromS } = this.dragged;
    this.dragged = null;
    mark.timeS = fromS;
    if (timeS !== null && timeS !== fromS) quietly(() => this.change(mark, { timeS }));
    else this.draw();
  }

  edit(mark) {
    const dialog = byId("mark-dialog", HTMLDialogElement);
    const [label, time] = ["mark-label", "mark-time"].map((id) => byId(id, HTMLInputElement));
    label.value = mark.label;
    const said = time.value = mark.timeS.toFixed(6);
    const cursorS = this.on.cursor();
    byId("mark-to-cursor", HTMLButtonElement).disabled = cursorS === null;
    byId("mark-to-cursor").onclick = () => { time.value = cursorS.toFixed(6); };
    dialog.returnValue = "";
    dialog.addEventListener("close", () => quietly(async () => {
      if (dialog.returnValue === "remove") await this.remove(mark);
      if (dialog.returnValue !== "ok") return;
      const timeS = time.value === said ? mark.timeS : Number.parseFloat(time.value.replace(",", "."));
      await this.change(mark, { label: label.value.trim(), timeS });
    }), { once: true });
    dialog.showModal();
  }

  draw() {
    this.version += 1;
    byId("marks-list").replaceChildren(...this.placed.map((mark) => {
      const go = el("button", { type: "button", cls: "small", text: `${timeWords(mark.timeS, 0.01)}  ${mark.label}` });
      go.addEventListener("click", () => this.on.go(mark.timeS));
      const edit = el("button", { type: "button", cls: "small presses", text: "✎", title: "Rename, move or remove", "aria-label": `Change the mark ${mark.label}` });
      edit.addEventListener("click", () => this.edit(mark));
      return el("li", { "data-time-s": mark.timeS.toFixed(6) }, go, edit);
    }));
    setText(byId("marks-doubt"), this.unmeasured && this.placed.length
      ? "The clocks of node and server were not compared: where the marks are is only as right as the node's clock." : "");
    this.on.changed();
  }
}
