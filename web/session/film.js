// Film in a video element: shows a picture by its number, or follows an instant at a speed.

import { intervalOf, pictureAt, pictureBefore } from "./film_time.js";

const RATES = [0.0625, 16]; // that browsers play
const FIRST_MS = 1500; // some browsers load no picture before they are asked for one
const APART_S = 0.2; // further away the film jumps, nearer it hurries or waits
const HURRY = 2; // of the rate, per second apart
const HURRY_MAX = 0.25;

/** Pictures of a film, on demand. */
export class Film {
  /** @param {HTMLVideoElement} element @param {() => void} onShown another picture is shown @param {() => void} onBroken it cannot be played */
  constructor(element, onShown, onBroken) {
    this.element = element;
    this.onShown = onShown;
    this.close();
    element.addEventListener("seeked", () => { if (!element.seeking) this.arrive(); }); // else another one was begun
    element.addEventListener("ended", () => this.show(this.times.length - 1));
    element.addEventListener("loadedmetadata", () => {
      if (!element.videoWidth) onBroken(); // sound alone
      else this.waiting = setInterval(() => this.beginUnseen(), FIRST_MS);
    });
    element.addEventListener("error", () => { if (element.hasAttribute("src")) onBroken(); });
    if (typeof element.requestVideoFrameCallback === "function") this.listen();
    else {
      element.addEventListener("loadeddata", () => this.begin(0));
      element.addEventListener("timeupdate", () => this.note(element.currentTime));
    }
  }

  /** Begin at 0 if no picture was reported although the film is loaded and the page is seen. */
  beginUnseen() {
    if (!document.hidden && this.element.networkState === this.element.NETWORK_IDLE) this.begin(0);
  }

  listen() {
    this.element.requestVideoFrameCallback((_, { mediaTime }) => {
      this.begin(mediaTime);
      this.note(mediaTime);
      this.listen();
    });
  }

  /**
   * Open a film at its first picture.
   * @param {string} address @param {number[]} times of its pictures, in s from the first
   * @param {number} slowness played time per its time: 33 if taken at 1000 pictures/s and played at 30
   * @param {number[] | null} [playTimes] of a trimmed film: of the same pictures, played s from the file's first one
   */
  open(address, times, slowness, playTimes = null) {
    this.close();
    [this.times, this.slowness, this.isTrimmed] = [times, slowness, playTimes !== null];
    this.playTimes = playTimes ?? times.map((timeS) => timeS * slowness);
    this.element.src = address;
  }

  close() {
    clearTimeout(this.waiting);
    this.element.removeAttribute("src");
    this.element.load();
    this.times = this.playTimes = [];
    this.slowness = 1;
    this.isTrimmed = false; // the element shows pictures that are none of the film's
    this.startS = null; // of the file's first picture by the element, in some files after 0; null: it is not there yet
    this.index = this.wanted = 0; // the picture shown; the one that it will be
    this.seeking = null;
  }

  begin(startS) {
    if (this.startS !== null || !this.times.length) return;
    clearTimeout(this.waiting);
    this.startS = startS;
    if (this.playTimes[0] > 0) this.seek();
    else this.arrive();
  }

  /** Return the element's time of an instant of the film. */
  elementTimeOf(filmS) {
    const before = pictureBefore(this.times, filmS);
    return this.startS + this.playTimes[before] + (filmS - this.times[before]) * this.slowness;
  }

  /** True while the picture shown is the one that is wanted. */
  get isStill() { return this.startS !== null && this.element.paused && this.seeking === null && this.index === this.wanted; }

  /** Note the picture of a playing film; of a trimmed one hidden pictures are skipped. */
  note(mediaS) {
    if (this.startS === null || this.element.paused || this.element.seeking) return;
    const playedS = mediaS - this.startS;
    const before = pictureBefore(this.playTimes, playedS);
    const isLast = before + 1 === this.times.length;
    const isOver = this.isTrimmed && playedS - this.playTimes[before] > 1.5 * this.shownS(before);
    if (isOver && isLast) this.show(before);
    else if (isOver && this.playTimes[before + 1] - playedS > this.shownS(before)) this.jump(before + 1);
    else {
      this.index = this.wanted = pictureAt(this.playTimes, playedS);
      this.onShown();
    }
  }

  /** Show a picture; while one is sought, the latest wins. */
  show(index) {
    const isMoving = !this.element.paused; // and a picture further than was noted
    this.element.pause();
    this.wanted = Math.min(this.times.length - 1, Math.max(0, index));
    if (this.startS !== null && this.seeking === null && (isMoving || this.index !== this.wanted)) this.seek();
  }

  seek() {
    this.seeking = this.wanted;
    this.jump(this.wanted);
  }

  /** Have the element go to the middle of a picture's interval: stamps are rounded. */
  jump(index) { this.element.currentTime = this.startS + this.playTimes[index] + this.shownS(index) / 2; }

  /** Return how long a picture is shown while the film plays; before a gap or a cut as long as the one before it. */
  shownS(index) { return this.slowness * Math.min(intervalOf(this.times, index), intervalOf(this.times, Math.max(0, index - 1))); }

  arrive() {
    if (this.seeking !== null) this.index = this.seeking;
    this.seeking = null;
    if (this.element.paused && this.index !== this.wanted) this.seek();
    else this.onShown();
  }

  /** Play on from an instant of the film at a speed of its own time; called again and again, it corrects its pace. */
  follow(filmS, speed) {
    const { element } = this;
    const rate = speed * this.slowness;
    if (this.startS === null || rate < RATES[0] || rate > RATES[1]) return this.show(pictureAt(this.times, filmS));
    const lateS = this.elementTimeOf(filmS) - element.currentTime;
    if (Math.abs(lateS) > APART_S * Math.max(1, rate) && !element.seeking) element.currentTime += lateS;
    this.play(speed * (1 + Math.min(HURRY_MAX, Math.max(-HURRY_MAX, HURRY * lateS / rate))));
  }

  /** Play at a speed of the film's time, as far as the browser can. */
  play(speed) {
    this.element.playbackRate = Math.min(RATES[1], Math.max(RATES[0], speed * this.slowness));
    if (!this.element.paused) return;
    this.seeking = null;
    this.element.play().catch(() => {}); // paused meanwhile, or it tells `error`
  }
}
