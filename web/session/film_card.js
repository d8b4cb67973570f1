// Film beside the plots, in step with their cursor both ways if it is aligned.

import * as api from "../common/api.js";
import { byId, setData, setText } from "../common/text.js";
import { Film } from "./film.js";
import { halfWidthText, intervalOf, Line, pictureAt } from "./film_time.js";
import { timeText } from "./overlay.js";

const INSTANT_S = 1e-4; // last digit of a picture's instant

/** Player of a film. */
export class FilmCard {
  /** @param {import("./plotted.js").Plotted} page @param {() => void} onShown */
  constructor(page, onShown) {
    this.page = page;
    this.box = byId("film-card");
    this.slider = byId("film-slider", HTMLInputElement);
    this.film = new Film(byId("film", HTMLVideoElement), () => { this.draw(); onShown(); }, () => this.refuse());
    /** @type {Video | null} */
    this.video = null;
    /** @type {Line | null} */
    this.line = null; // of its alignment
    this.followedS = null; // cursor that the film has followed
    this.wasGoing = false;
    this.isApart = false; // while it is aligned by hand
    byId("picture-before").addEventListener("click", () => this.step(-1));
    byId("picture-next").addEventListener("click", () => this.step(1));
    byId("film-play").addEventListener("click", () => this.toggle());
    this.slider.addEventListener("input", () => this.goTo(Number(this.slider.value)));
    for (const name of ["play", "pause"]) this.film.element.addEventListener(name, () => this.draw());
  }

  /** Show a video; again after its alignment has changed. @param {Video | null} video */
  async show(video) {
    const isOther = this.video?.id !== video?.id;
    this.video = video;
    this.line = video?.alignment ? new Line(video.alignment, this.page.plots.whole.beginNs) : null;
    this.followedS = null;
    this.box.hidden = !video;
    if (isOther) {
      this.film.close();
      setText(byId("film-problem"), "");
      const { id } = this.page.session;
      const times = video && (await api.filmTimes(id, video.id)).film_s;
      if (this.video !== video) return; // another one was asked for meanwhile
      if (video) this.film.open(api.filmAddress(id, video.id), times, video.film.rate_hz / video.film.play_rate_hz || 1);
    }
    this.draw();
    this.follow();
  }

  refuse() {
    this.film.close();
    setText(byId("film-problem"), `This browser cannot play ${this.video.film.codec} in ${this.video.suffix.slice(1).toUpperCase()}: open the page in another browser, or add a copy in `
      + "H.264 (ffmpeg -i FILM -c:v libx264 COPY.mp4); alignment by light or clock page works nevertheless.");
    this.draw();
  }

  get isPlayable() { return this.film.times.length > 0; }
  get inStep() { return this.line !== null && !this.isApart && this.isPlayable; }

  setApart(isApart) {
    this.isApart = isApart;
    this.followedS = null;
    this.draw();
    this.follow();
  }

  step(by) {
    if (!this.isPlayable) return;
    this.page.replay.playing.stop();
    this.goTo(this.film.wanted + by);
  }

  /** Show a picture, and move the cursor to it if the session has its instant. */
  goTo(index) {
    this.film.show(index);
    if (this.inStep) {
      const timeS = this.line.toSession(this.film.times[this.film.wanted]);
      if (timeS >= 0 && timeS <= this.page.durationS) this.page.cursorTo(timeS);
    }
    this.draw();
  }

  toggle() {
    if (this.film.element.paused) this.film.play(this.page.replay.playing.speed);
    else this.film.show(this.film.index);
  }

  /** Follow the cursor, if it has moved or the playback has begun or ended. */
  follow() {
    const { cursorS, replay: { playing } } = this.page;
    const isOutside = this.inStep && cursorS !== null && !this.hasInstant(this.line.toFilm(cursorS));
    setData(this.box, "outside", String(isOutside));
    setText(byId("film-over"), isOutside ? `Outside the film: it runs from ${this.textOf(0)} to ${this.textOf(this.film.times.length - 1)}` : "");
    if (!this.inStep || cursorS === null || (cursorS === this.followedS && playing.going === this.wasGoing)) return;
    [this.followedS, this.wasGoing] = [cursorS, playing.going];
    const filmS = this.line.toFilm(cursorS);
    if (playing.going && !playing.calm.matches && !isOutside) this.film.follow(filmS, playing.speed);
    else this.film.show(pictureAt(this.film.times, filmS));
  }

  hasInstant(filmS) {
    const { times } = this.film;
    return filmS >= -intervalOf(times, 0) / 2 && filmS <= times.at(-1) + intervalOf(times, times.length - 1);
  }

  textOf(index) { return timeText(this.line.toSession(this.film.times[index]), 0.01); }

  draw() {
    const { film, inStep } = this;
    const filmS = film.times[film.index] ?? 0;
    const [count, number] = [film.times.length, (film.index + 1).toLocaleString("en-GB")];
    const where = this.line ? `${timeText(this.line.toSession(filmS), INSTANT_S)} ${halfWidthText(this.line.halfWidth(filmS))}` : `${timeText(filmS, 0.001)} of the film, not aligned`;
    setText(byId("film-at"), count ? `Picture ${number} of ${count.toLocaleString("en-GB")}: ${where}` : "");
    setData(this.box, "picture", String(film.index));
    setData(this.box, "still", String(film.isStill));
    byId("film-tools").hidden = byId("film-box").hidden = !count;
    byId("film-play").hidden = inStep; // the session's player plays both
    setText(byId("film-play"), film.element.paused ? "Play film" : "Pause film");
    byId("still-add", HTMLButtonElement).disabled = !this.line;
    this.slider.max = String(Math.max(0, count - 1));
    this.slider.value = String(film.wanted);
  }
}
