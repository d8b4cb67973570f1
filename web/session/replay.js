// Replay: the live page's foot and bars with the session's frames.

import { ESTIMATE } from "../common/flags.js";
import { Bars } from "../live/bars.js";
import { Foot } from "../live/foot.js";
import { drawGrf } from "../live/grf.js";
import { Range } from "../live/range.js";
import { byId, el, number, setData, setText } from "../common/text.js";
import { timeText } from "./overlay.js";
import { Playing, SPEEDS } from "./playing.js";
import { Samples } from "./samples.js";

const AHEAD_S = 1.5; // prefetch, in time of the display
const SPEED_TEXTS = { 0.1: "0.1×", 0.25: "0.25×", 1: "1×", 4: "4×" };
const JUMP_S = 0.1;

/** Return the GRF of a frame with its 95 % interval, such as "22.1 ± 0.3 N". */
function forceText({ grf_n: grf, grf_sigma_n: sigma, grf_lower_bound_n: bound, estimate_flags: bits = 0 }, node) {
  const isAssumed = node?.calibration?.absolute_scale === "assumed" || bits & ESTIMATE.ASSUMED_SCALE;
  if (Number.isFinite(grf)) return `${number(grf)}${Number.isFinite(sigma) ? ` ± ${number(1.96 * sigma)}` : ""} N${isAssumed ? ", assumed scale" : ""}`;
  return Number.isFinite(bound) ? `≥ ${number(Math.max(0, Math.floor(bound * 10) / 10))} N` : "force unknown";
}

/** Foot at the cursor, and the player. */
export class Replay {
  /**
   * @param {object} on
   * @param {() => number} on.at cursor, or start of playback, s
   * @param {() => import("./view.js").View} on.range what is played
   * @param {(timeS: number) => void} on.go moves cursor and view
   * @param {() => void} on.changed requests a drawing
   * @param {(error: Error) => void} on.failed
   */
  constructor(on) {
    this.on = on;
    this.samples = null;
    /** @type {ArrayView | null} */
    this.array = null;
    this.range = this.foot = this.bars = null;
    this.walking = Promise.resolve();
    this.playing = new Playing({
      at: on.at, go: on.go, range: on.range,
      ready: () => this.samples.has(on.at(), 0), changed: () => { this.drawControls(); on.changed(); },
    });
    byId("play").addEventListener("click", () => this.toggle());
    byId("speeds").append(...SPEEDS.map((speed) => {
      const button = el("button", { type: "button", cls: "small", text: SPEED_TEXTS[speed], "data-speed": String(speed), "aria-label": `${speed} times` });
      button.addEventListener("click", () => { this.playing.speed = speed; this.drawControls(); });
      return button;
    }));
    this.drawControls();
  }

  /**
   * Open a session; again after it has grown or was sealed.
   * @param {string} id @param {import("./bins.js").Bins} whole
   */
  open(id, whole) {
    const before = this.samples?.whole;
    if (before?.provisional && whole.provisional && before.estimated === whole.estimated) this.samples.grow(whole);
    else {
      const rateHz = whole.sum("frames", 0, whole.count) / Math.max(1e-3, whole.durationS);
      this.samples = new Samples(id, whole, rateHz, { loaded: this.on.changed, failed: this.on.failed });
      this.shown = null;
    }
    byId("replay").hidden = false;
    setData(byId("stage"), "replay", "true");
    for (const part of ["replay-foot", "bars-card"]) byId(part).hidden = !whole.estimated;
    this.writeLag();
  }

  /** Set tiles and calibration; the foot is drawn from then on. @param {ArrayView} array of GET /sessions/ID/tiles */
  setArray(array) {
    this.array = array;
    this.writeLag();
    if (!this.samples.whole.estimated) return;
    // Estimated frames have a tare and a calibration.
    this.node = { ...array, tare: {}, calibration: array.calibration ?? {} };
    const redraw = () => { this.shown = null; this.on.changed(); };
    this.range ??= new Range(byId("range"), redraw);
    this.foot ??= new Foot(this.range);
    this.foot.resized = redraw;
    this.bars ??= new Bars(redraw, this.range);
    redraw();
  }

  writeLag() {
    const { whole } = this.samples;
    const { lag_ms: lagMs = null, estimates_problem: problem = null } = this.array ?? { lag_ms: null, estimates_problem: null };
    const lookAhead = lagMs === null ? "" : `use ${number(lagMs, 0)} ms of look-ahead.`;
    let text = lookAhead && `Stored forces ${lookAhead}`;
    if (whole.provisional) text = lookAhead && `Provisional forces ${lookAhead} Sealing estimates them again with more.`;
    if (!whole.estimated) text = problem || !whole.provisional ? `No forces: ${problem ?? "not estimated"}.` : "";
    setText(byId("replay-lag"), text);
  }

  toggle() { if (this.samples) this.playing.toggle(); }

  /** Step by a frame, or jump by some time; keys are handled in order. */
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
    this.walking = step.catch(() => {}); // an error does not stop later steps
  }

  draw() {
    const { samples } = this;
    if (!samples) return;
    const timeS = this.on.at();
    samples.request(timeS, this.playing.going ? AHEAD_S * this.playing.speed : 0);
    const { known, frame } = samples.at(timeS);
    const panel = byId("replay");
    setData(panel, "waiting", String(!known));
    if (!known) return; // keep the picture until it is loaded
    const key = frame ? `${frame.timeS} ${frame.seq}` : "none";
    if (key === this.shown) return;
    this.shown = key;
    setData(panel, "none", String(!frame));
    setData(panel, "timeS", frame ? String(frame.timeS) : "");
    setData(panel, "seq", frame ? String(frame.seq) : "");
    setText(byId("replay-time"), frame ? timeText(frame.timeS, 0.001) : "No frame here");
    setText(byId("replay-force"), frame && samples.whole.estimated ? `, ${forceText(frame, this.node)}` : "");
    setText(byId("replay-frame"), frame ? `, frame ${frame.seq.toLocaleString("en-GB")}` : "");
    if (!this.node) return;
    this.bars.draw(this.node, frame, performance.now());
    this.foot.draw(this.node, frame, this.bars.shown);
    drawGrf(this.node, frame);
  }

  drawControls() {
    const { going, speed } = this.playing;
    setText(byId("play-text"), going ? "Pause" : "Play");
    setData(byId("play"), "going", String(going));
    for (const button of byId("speeds").querySelectorAll("button")) button.setAttribute("aria-pressed", String(Number(button.dataset.speed) === speed));
  }
}
