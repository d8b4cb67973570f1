// When the page draws: a message is one picture, and what can only be read is written less often.
//
// A picture costs the same whether it shows something new or not, so no display frame is asked for
// in between. Numbers that change thirty times a second cannot be read, and to lay out their text
// costs more than all that is drawn.

const ANYWAY_MS = 50; // without messages time goes on, too: the trace moves, and is late in grey
const READ_MS = 200; // five times a second

export class Pace {
  /** @param {() => void} draw */
  constructor(draw) {
    this.draw = draw;
    this.asked = false;
    this.timer = 0;
  }

  /** There is something to draw in the next display frame; a hidden page has none. */
  ask() {
    if (this.asked) return;
    this.asked = true;
    clearTimeout(this.timer);
    requestAnimationFrame(() => {
      this.asked = false;
      this.timer = setTimeout(() => this.ask(), ANYWAY_MS);
      this.draw();
    });
  }
}

/** Whether the numbers of a frame are to be written now. */
export class Reading {
  constructor() {
    this.again();
  }

  /** Next time, whatever was written: they are shown in another way. */
  again() {
    this.node = this.frame = undefined;
    this.kind = "";
    this.writtenMs = 0;
  }

  /** At once where another thing is to be said, such as a fault; another value of the same waits its turn. */
  isDue(node, frame, nowMs) {
    if (node === this.node && frame === this.frame) return false;
    const kind = kindOf(frame);
    if (node === this.node && kind === this.kind && nowMs - this.writtenMs < READ_MS) return false;
    [this.node, this.frame, this.kind, this.writtenMs] = [node, frame, kind, nowMs];
    return true;
  }
}

/** What can be said of a frame, but for the values. @param {Frame | null} frame */
function kindOf(frame) {
  if (!frame) return "";
  const known = (value) => (Number.isFinite(value) ? 1 : 0);
  const list = (name, of) => frame[name]?.map(of).join("") ?? "";
  return [
    frame.status?.join(), list("saturated", Number), list("force_n", known), list("gauge_kpa", known), list("force_sigma_n", known),
    known(frame.grf_n), known(frame.grf_at_least_n), known(frame.grf_sigma_n), frame.contact, known(frame.cop_x_m),
    known(frame.cop_y_m), known(frame.angle_rad),
    frame.frame_status, frame.estimate_status,
  ].join(" ");
}
