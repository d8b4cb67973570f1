// Playback clock. Independent of data.

export const SPEEDS = [0.1, 0.25, 1, 4];
const LEAP_MAX_MS = 250; // after a stall of the display
const CALM_MS = 500; // between pictures with reduced motion

/** Moves the cursor at a speed. */
export class Playing {
  /**
   * @param {object} on
   * @param {() => number} on.at cursor, s
   * @param {() => import("./view.js").View} on.range what is played
   * @param {() => boolean} on.ready the next frames are loaded
   * @param {(timeS: number) => void} on.go moves the cursor
   * @param {() => void} on.changed started or stopped
   */
  constructor(on) {
    this.on = on;
    this.speed = 1;
    this.request = 0;
    this.calm = matchMedia("(prefers-reduced-motion: reduce)");
  }

  get going() { return this.request !== 0; }

  toggle() {
    if (this.going) this.stop();
    else this.start();
  }

  start() {
    const { from, to } = this.on.range();
    if (this.on.at() < from || this.on.at() >= to) this.on.go(from);
    this.lastMs = null;
    this.request = requestAnimationFrame((nowMs) => this.tick(nowMs));
    this.on.changed();
  }

  stop() {
    cancelAnimationFrame(this.request);
    this.request = 0;
    this.on.changed();
  }

  tick(nowMs) {
    this.request = requestAnimationFrame((next) => this.tick(next));
    const sinceMs = nowMs - (this.lastMs ?? nowMs);
    if (this.calm.matches && this.lastMs !== null && sinceMs < CALM_MS) return;
    this.lastMs = nowMs;
    if (!sinceMs || !this.on.ready()) return;
    const leapMs = Math.min(sinceMs, this.calm.matches ? 2 * CALM_MS : LEAP_MAX_MS);
    const endS = this.on.range().to;
    const toS = Math.min(endS, this.on.at() + this.speed * leapMs * 1e-3);
    this.on.go(toS);
    if (toS >= endS) this.stop();
  }
}
