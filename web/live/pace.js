// Drawing pace: trace and bars with each message, a frame's numbers and the foot less often.
//
// A drawing costs the same with and without news, so none is requested in between. Nobody reads
// numbers that change thirty times a second, and a foot of another frame would contradict them.

const IDLE_MS = 50; // without messages the trace still moves
const FRAME_MS = 100;

/** Requests at most one drawing per display frame. */
export class Pace {
  /** @param {() => void} draw */
  constructor(draw) {
    this.draw = draw;
    this.requested = false;
    this.timer = 0;
  }

  /** Draw in the next display frame; a hidden page has none. */
  request() {
    if (this.requested) return;
    this.requested = true;
    clearTimeout(this.timer);
    requestAnimationFrame(() => {
      this.requested = false;
      this.timer = setTimeout(() => this.request(), IDLE_MS);
      this.draw();
    });
  }
}

/** Decides whether to show a frame now. */
export class FramePace {
  constructor() {
    this.reset();
  }

  /** Show the next one in any case: the display has changed. */
  reset() {
    this.node = this.frame = undefined;
    this.state = "";
    this.shownMs = 0;
  }

  /** Return true at once for another state, such as a fault; for another value of the same state every `FRAME_MS`. */
  isDue(node, frame, nowMs) {
    if (node === this.node && frame === this.frame) return false;
    const state = stateOf(frame);
    if (node === this.node && state === this.state && nowMs - this.shownMs < FRAME_MS) return false;
    [this.node, this.frame, this.state, this.shownMs] = [node, frame, state, nowMs];
    return true;
  }
}

/** Return the state of a frame without its values. @param {FrameMessage | null} frame */
function stateOf(frame) {
  if (!frame) return "";
  const known = (value) => (Number.isFinite(value) ? 1 : 0);
  const list = (name, of) => frame[name]?.map(of).join("") ?? "";
  return [
    frame.tile_flags?.join(), list("saturated", Number), list("force_n", known), list("gauge_kpa", known), list("force_sigma_n", known),
    known(frame.grf_n), known(frame.grf_lower_bound_n), known(frame.grf_sigma_n), frame.contact, known(frame.cop_x_m),
    known(frame.cop_y_m), known(frame.angle_rad),
    frame.frame_flags, frame.estimate_flags,
  ].join(" ");
}
