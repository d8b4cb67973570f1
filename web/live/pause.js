// A picture that stands still while data go on, and says so.

import { byId, localTime, setText } from "../common/text.js";

export class Pause {
  /** `onChange()` when it begins or ends. */
  constructor(onChange) {
    this.onChange = onChange;
    this.held = null; // the frame that is shown, and when it was
    this.newest = null; // gives the newest frame
    for (const name of ["pause", "go-on"]) byId(name).addEventListener("click", () => this.toggle());
  }

  toggle() {
    if (this.held) return this.goOn();
    const frame = this.newest?.();
    if (!frame) return; // there is no picture
    this.held = { frame, nowMs: performance.now() };
    setText(byId("paused-text"), `Paused at ${localTime(new Date()).slice(11)}. The picture stands still; data and recordings go on.`);
    this.show();
  }

  goOn() {
    if (!this.held) return;
    this.held = null;
    const back = document.activeElement === byId("go-on");
    this.show();
    if (back) byId("pause").focus();
  }

  show() {
    byId("paused").hidden = !this.held;
    document.body.dataset.paused = String(Boolean(this.held));
    byId("pause").setAttribute("aria-pressed", String(Boolean(this.held)));
    this.onChange();
  }
}
