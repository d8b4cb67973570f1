// Pause of the display while acquisition continues.

import { byId, localTime, setText } from "../common/text.js";

/** Pause button, and the frame that stays on display. */
export class Pause {
  /** `onChange()` runs at pause and resume. */
  constructor(onChange) {
    this.onChange = onChange;
    this.held = null; // frame on display, and its time
    this.latest = null; // returns the latest frame
    byId("pause").addEventListener("click", () => this.toggle());
  }

  toggle() {
    if (this.held) return this.resume();
    const frame = this.latest?.();
    if (!frame) return; // nothing to hold
    this.held = { frame, nowMs: performance.now() };
    setText(byId("paused-text"), `Paused at ${localTime(new Date()).slice(11)}.`);
    this.show();
  }

  resume() {
    if (!this.held) return;
    this.held = null;
    this.show();
  }

  show() {
    byId("paused").hidden = !this.held;
    document.body.dataset.paused = String(Boolean(this.held));
    setText(byId("pause-text"), this.held ? "Resume" : "Pause");
    this.onChange();
  }
}
