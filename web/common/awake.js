// Keeps the screen on: by the Screen Wake Lock API, or where it is missing (plain HTTP) by a silent video.

import { isChosen, storeChoice } from "./choice.js";

const KEY = "foottile.awake";
const REWIND_AT_S = 2; // Safari lets the screen go dark during a video with the attribute `loop`
const BLOCKED = "tap this page once";
const REFUSED = "the device refuses, perhaps to save energy";
const NO_VIDEO = "this browser cannot play the silent video";

/** Switch that keeps the screen on while the page is visible. */
export class Awake {
  /** @param {() => void} onChange called when `state` has changed */
  constructor(onChange) {
    this.onChange = onChange;
    this.chosen = isChosen(KEY);
    this.lock = null;
    this.video = null;
    this.isAsking = false;
    this.reason = "";
    // Loaded now: when it is played, a tap must have been just before.
    this.silent = "wakeLock" in navigator ? null : import("./silent_video.js");
    this.silent?.catch(() => {}); // said by `hold`
    document.addEventListener("visibilitychange", () => this.hold());
    document.addEventListener("pointerup", () => this.hold()); // a video may need a tap
    this.hold();
  }

  get isHeld() {
    return this.lock?.released === false || this.video?.paused === false;
  }

  /** State in words. */
  get state() {
    if (!this.chosen) return "off";
    return this.isHeld ? "screen stays on" : `screen may go dark: ${this.reason || "asking the device"}`;
  }

  choose(on) {
    this.chosen = on;
    storeChoice(KEY, on);
    if (on) this.hold();
    else this.release();
    this.onChange();
  }

  release() {
    this.lock?.release();
    this.video?.remove();
    this.lock = this.video = null;
  }

  /** Ask for the screen if it is not kept on; the browser drops a lock when it hides the page. */
  async hold() {
    if (!this.chosen || document.hidden || this.isHeld || this.isAsking) return;
    this.isAsking = true;
    try {
      await ("wakeLock" in navigator ? this.lockScreen() : this.playVideo());
      this.reason = "";
    } catch (error) {
      const isRefused = /** @type {Error} */ (error).name === "NotAllowedError";
      this.reason = "wakeLock" in navigator ? REFUSED : isRefused ? BLOCKED : NO_VIDEO;
    }
    this.isAsking = false;
    if (!this.chosen) this.release();
    this.onChange();
  }

  async lockScreen() {
    this.lock = await navigator.wakeLock.request("screen");
    this.lock.addEventListener("release", () => {
      if (document.hidden) return; // requested again when the page is shown
      this.reason = REFUSED;
      this.onChange();
    });
  }

  async playVideo() {
    const { SILENT_VIDEO } = await this.silent;
    this.video?.remove();
    const video = this.video = document.createElement("video");
    video.className = "unseen";
    video.setAttribute("playsinline", "");
    video.setAttribute("aria-hidden", "true");
    video.tabIndex = -1;
    video.src = SILENT_VIDEO;
    video.addEventListener("timeupdate", () => { if (video.currentTime > REWIND_AT_S) video.currentTime = 0; });
    video.addEventListener("pause", () => this.onChange());
    document.body.append(video);
    await video.play();
  }
}
