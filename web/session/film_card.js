// Film beside the plots, in step with their cursor both ways if it is aligned.

import { byId, setData, setText } from "../common/text.js";
import { Film } from "./film.js";
import { halfWidthText, intervalOf, Line, pictureAt } from "./film_time.js";
import { timeText } from "./overlay.js";
import * as videoApi from "./video_api.js";

const INSTANT_S = 1e-4; // last digit of a picture's instant
export const UNCERTAIN = "Which pictures of this film a browser shows is not known: it has an edit list that browsers read differently, or was added before this was looked at. "
  + "Add it again; if this stays, add a copy made by “ffmpeg -i FILM -c:v libx264 COPY.mp4”. Alignment by light or clock page works nevertheless.";

/** Player of a film. */
export class FilmCard {
  /** @param {import("./plotted.js").Plotted} page */
  constructor(page) {
    this.page = page;
    this.box = byId("film-card");
    this.slider = byId("film-slider", HTMLInputElement);
    this.film = new Film(byId("film", HTMLVideoElement), () => this.draw(), () => this.refuse());
    /** @type {Video | null} */
    this.video = null;
    /** @type {Line | null} */
    this.line = null; // of its alignment
    this.followedS = null; // cursor that the film has followed
    this.wasGoing = false;
    this.isApart = false; // while it is aligned by hand
    byId("picture-before").addEventListener("click", () => this.step(-1));
    byId("picture-next").addEventListener("click", () => this.step(1));
    const { element } = this.film;
    byId("film-play").addEventListener("click", () => (element.paused ? this.film.play(page.replay.playing.speed) : this.film.show(this.film.index)));
    this.slider.addEventListener("input", () => this.goTo(Number(this.slider.value)));
    for (const name of ["play", "pause"]) element.addEventListener(name, () => this.draw());
  }

  /** Show a video; again after its alignment has changed. @param {Video | null} video */
  async show(video) {
    const isOther = !this.isOpen || this.video?.id !== video?.id;
    this.video = video;
    this.line = video?.alignment ? new Line(video.alignment, this.page.plots.whole.beginNs) : null;
    this.box.hidden = !video;
    if (isOther) {
      this.isOpen = false;
      this.film.close();
      setText(byId("film-problem"), video && !this.isCertain ? UNCERTAIN : "");
      this.draw();
      setText(byId("film-at"), "The server reads the times of its pictures …");
      const { id } = this.page.session;
      const { film_s: times, whole_s: playTimes } = video ? await videoApi.filmTimes(id, video.id) : { film_s: [] };
      if (this.video?.id !== video?.id) return; // another one was asked for meanwhile
      this.isOpen = true;
      const address = playTimes ? videoApi.wholeFilmAddress : videoApi.filmAddress;
      if (video) this.film.open(address(id, video.id), times, video.film.rate_hz / video.film.play_rate_hz || 1, playTimes);
    }
    this.update();
  }

  update() {
    this.followedS = null;
    this.draw();
    this.follow();
  }

  refuse() {
    this.film.close();
    const { film: { codec }, suffix } = this.video;
    setText(byId("film-problem"), `This browser cannot play ${codec} in ${suffix.slice(1).toUpperCase()}: open the page in another one, or add a copy made by `
      + "“ffmpeg -i FILM -c:v libx264 COPY.mp4”; alignment by light or clock page works nevertheless.");
    this.draw();
  }

  /** True if this page shows the pictures that the server counts. */
  get isCertain() { return this.video?.film.hidden_count !== null; }

  get inStep() { return this.line !== null && this.isCertain && !this.isApart && this.film.times.length > 0; }

  setApart(isApart) {
    this.isApart = isApart;
    this.update();
  }

  step(by) {
    if (!this.film.times.length) return;
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

  /** Follow the cursor, if it has moved or the playback has begun or ended. */
  follow() {
    const { film: { times }, page: { cursorS, replay: { playing } } } = this;
    const isLed = this.inStep && cursorS !== null;
    const filmS = isLed ? this.line.toFilm(cursorS) : 0;
    const isOutside = isLed && (filmS < -intervalOf(times, 0) / 2 || filmS > times.at(-1) + intervalOf(times, times.length - 1));
    const [from, to] = isOutside ? [0, times.at(-1)].map((endS) => timeText(this.line.toSession(endS), 0.01)) : [];
    setData(this.box, "outside", String(isOutside));
    setText(byId("film-over"), isOutside ? `Outside the film: it runs from ${from} to ${to}` : "");
    if (!isLed || (cursorS === this.followedS && playing.going === this.wasGoing)) return;
    [this.followedS, this.wasGoing] = [cursorS, playing.going];
    if (playing.going && !playing.calm.matches && !isOutside) this.film.follow(filmS, playing.speed);
    else this.film.show(pictureAt(times, filmS));
  }

  draw() {
    const { film, inStep } = this;
    const filmS = film.times[film.index] ?? 0;
    const [count, number] = [film.times.length, (film.index + 1).toLocaleString("en-GB")];
    const where = !this.isCertain ? "its instant is not known" : this.line ? `${timeText(this.line.toSession(filmS), INSTANT_S)} ${halfWidthText(this.line.halfWidth(filmS))}` : `${timeText(filmS, 0.001)} of the film, not aligned`;
    setText(byId("film-at"), count ? `Picture ${number} of ${count.toLocaleString("en-GB")}: ${where}` : "");
    setData(this.box, "picture", String(film.index));
    setData(this.box, "still", String(film.isStill));
    byId("film-tools").hidden = byId("film-box").hidden = !count;
    byId("film-play").hidden = inStep; // the session's player plays both
    setText(byId("film-play"), film.element.paused ? "Play film" : "Pause film");
    byId("still-add", HTMLButtonElement).disabled = !this.line || !this.isCertain;
    this.slider.max = String(Math.max(0, count - 1));
    this.slider.value = String(film.wanted);
  }
}
