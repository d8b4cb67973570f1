// Marks of a session on its time axis, listed to go to, and set at the cursor.

import * as api from "../common/api.js";
import { notice } from "../common/notices.js";
import { byId, el, setText } from "../common/text.js";
import { timeWords } from "./overlay.js";

export class Marks {
  /** @param {string} id @param {(timeS: number) => void} onGo @param {() => void} onChange */
  constructor(id, onGo, onChange) {
    this.id = id;
    this.onGo = onGo;
    this.onChange = onChange;
    this.placed = [];
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
    this.placed.push({ id: event.id, label: event.label, timeS: (event.t_ns - (offset ?? 0) - this.beginNs) * 1e-9 });
    this.placed.sort((a, b) => a.timeS - b.timeS);
  }

  async add(timeS) {
    const field = byId("new-mark-label");
    const label = field.value.trim() || "mark";
    const tNs = this.beginNs + timeS * 1e9;
    // A rounded number of this size is right to a quarter of a microsecond.
    const event = await api.markEvent(this.id, { label, t_ns: Math.round(tNs + (this.offset(tNs, false) ?? 0)) });
    field.value = "";
    this.place(event);
    this.draw();
    this.onChange();
    notice(`Marked “${label}”.`);
  }

  draw() {
    byId("marks-list").replaceChildren(...this.placed.map((mark) => {
      const go = el("button", { type: "button", cls: "small", text: `${timeWords(mark.timeS, 0.01)}  ${mark.label}` });
      go.addEventListener("click", () => this.onGo(mark.timeS));
      return el("li", { "data-time-s": mark.timeS.toFixed(6) }, go);
    }));
    setText(byId("marks-doubt"), this.unmeasured && this.placed.length
      ? "The clocks of node and server were not compared: where the marks are is only as right as the node's clock." : "");
  }
}
