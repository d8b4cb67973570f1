// The foot at the cursor: the live view's pictures, fed with a session's own frames, and played.

import { Bars } from "../live/bars.js";
import { Foot } from "../live/foot.js";
import { drawGrf } from "../live/grf.js";
import { Range } from "../live/range.js";
import { byId, el, number, setData, setText } from "../common/text.js";
import { timeWords } from "./overlay.js";
import { Playing, SPEEDS } from "./playing.js";
import { Samples } from "./samples.js";

const AHEAD_S = 1.5; // of the display's time: what is asked for before it is needed
const SPEED_WORDS = { 0.1: "0.1×", 0.25: "0.25×", 1: "1×", 4: "4×" };
const JUMP_S = 0.1;

export class Replay {
  /**
   * @param {object} on
   * @param {() => number} on.at where the cursor is, or where playing would begin
   * @param {(timeS: number) => void} on.go puts the cursor there, and the view with it
   * @param {() => void} on.changed something has to be drawn
   * @param {(error: Error) => void} on.failed
   */
  constructor(on) {
    this.on = on;
    this.samples = null;
    /** @type {Dressed | null} */
    this.array = null;
    this.range = this.foot = this.bars = null;
    this.walking = Promise.resolve();
    this.playing = new Playing({
      at: on.at, go: on.go, end: () => this.samples.whole.durationS,
      ready: () => this.samples.has(on.at(), 0), changed: () => { this.drawControls(); on.changed(); },
    });
    byId("play").addEventListener("click", () => this.toggle());
    byId("speeds").append(...SPEEDS.map((speed) => {
      const button = el("button", { type: "button", cls: "small", text: SPEED_WORDS[speed], "data-speed": String(speed), "aria-label": `${speed} times` });
      button.addEventListener("click", () => { this.playing.speed = speed; this.drawControls(); });
      return button;
    }));
    this.drawControls();
  }

  /**
   * Again whenever the session has grown, or was sealed.
   * @param {string} id @param {import("./bins.js").Bins} whole
   */
  open(id, whole) {
    const before = this.samples?.whole;
    if (before?.provisional && whole.provisional && before.estimated === whole.estimated) this.samples.grow(whole);
    else {
      const rateHz = whole.sum("frames", 0, whole.count) / Math.max(1e-3, whole.durationS);
      this.samples = new Samples(id, whole, rateHz, { come: this.on.changed, failed: this.on.failed });
      this.shown = null;
    }
    byId("replay").hidden = false;
    setData(byId("stage"), "replay", "true");
    for (const part of ["replay-foot", "bars-card"]) byId(part).hidden = !whole.estimated;
    this.sayLag();
  }

  /** @param {Dressed} array of GET /sessions/ID/array: until it is there the foot is not drawn */
  dress(array) {
    this.array = array;
    this.sayLag();
    if (!this.samples.whole.estimated) return;
    // Estimated frames have a tare and a calibration, whatever is known of these.
    this.node = { ...array, tare: {}, calibration: array.calibration ?? {} };
    const again = () => { this.shown = null; this.on.changed(); };
    this.range ??= new Range(byId("range"), again);
    this.foot ??= new Foot(this.range);
    this.foot.resized = again;
    this.bars ??= new Bars(again, this.range);
    again();
  }

  sayLag() {
    const { whole } = this.samples;
    const { lag_ms: lagMs = null, estimates_problem: problem = null } = this.array ?? { lag_ms: null, estimates_problem: null };
    const looks = lagMs === null ? "" : `each takes notice of the ${number(lagMs, 0)} ms behind it.`;
    let text = looks && `Forces as they are stored: ${looks}`;
    if (whole.provisional) text = looks && `Provisional forces, as they are live: ${looks} They are estimated once more when the session is sealed, with more of what follows.`;
    if (!whole.estimated) text = problem || !whole.provisional ? `There are no forces: ${problem ?? "they were not estimated"}.` : "";
    setText(byId("replay-lag"), text);
  }

  toggle() { if (this.samples) this.playing.toggle(); }

  /** From frame to frame, or by some time; one key after the other. */
  walk(by, jump) {
    if (!this.samples) return;
    if (this.playing.going) this.playing.stop();
    const step = this.walking.then(async () => {
      const { samples } = this;
      const fromS = this.on.at();
      if (!jump) return this.on.go(await samples.step(fromS, by));
      const toS = Math.min(samples.whole.durationS, Math.max(0, fromS + by * JUMP_S));
      return this.on.go(await samples.step(toS, 0));
    });
    step.catch(this.on.failed);
    this.walking = step.catch(() => {}); // the next key has its step all the same
  }

  draw() {
    const { samples } = this;
    if (!samples) return;
    const timeS = this.on.at();
    samples.want(timeS, this.playing.going ? AHEAD_S * this.playing.speed : 0);
    const { known, frame } = samples.at(timeS);
    const panel = byId("replay");
    setData(panel, "waiting", String(!known));
    if (!known) return; // what was shown stays until it is there
    const key = frame ? `${frame.timeS} ${frame.seq}` : "none";
    if (key === this.shown) return;
    this.shown = key;
    setData(panel, "none", String(!frame));
    setData(panel, "timeS", frame ? String(frame.timeS) : "");
    setData(panel, "seq", frame ? String(frame.seq) : "");
    setText(byId("replay-at"), frame ? `${timeWords(frame.timeS, 0.001)}, frame ${frame.seq.toLocaleString("en-GB")}` : "No frame was recorded here.");
    if (!this.node) return;
    this.foot.draw(this.node, frame);
    this.bars.draw(this.node, frame, performance.now());
    drawGrf(this.node, frame);
  }

  drawControls() {
    const { going, speed } = this.playing;
    setText(byId("play-text"), going ? "Pause" : "Play");
    setData(byId("play"), "going", String(going));
    for (const button of byId("speeds").querySelectorAll("button")) button.setAttribute("aria-pressed", String(Number(button.dataset.speed) === speed));
  }
}
