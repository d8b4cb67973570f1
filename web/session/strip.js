// Strip of stills: pictures side by side with their instants, and the force below, white for print.

import * as api from "../common/api.js";
import { decimalsOf, ticks } from "../common/axes.js";
import { notice, quietly } from "../common/notices.js";
import { byId, el, localTime, number, printable } from "../common/text.js";
import { Bins } from "./bins.js";
import { halfWidthText } from "./film_time.js";
import { timeLabel, timeText } from "./overlay.js";
import { saveCanvas } from "./picture.js";
import { drawBand, drawSeries } from "./series.js";
import { around } from "./view.js";

const STILLS_MAX = 8;
const [WIDTH, GAP, LEFT, HEAD, TEXT, CURVE, FOOT] = [1800, 12, 90, 44, 58, 340, 64]; // px
const STILL = { width: 560, height: 480 }; // px, at most
const [INK, GREY, GRID, BLUE, PALE] = ["#000000", "#555555", "#d5d5d5", "#0b4fb3", "#c3d8f7"];

/** Stills of a film, and their picture. */
export class Strip {
  /** @param {import("./plotted.js").Plotted} page @param {import("./film_card.js").FilmCard} card */
  constructor(page, card) {
    this.page = page;
    this.card = card;
    this.canvas = byId("strip-canvas", HTMLCanvasElement);
    /** @type {{timeS: number, text: string, picture: HTMLCanvasElement}[]} */
    this.stills = [];
    byId("still-add").addEventListener("click", () => this.add());
    byId("strip-save").addEventListener("click", () => saveCanvas(this.canvas, `${page.session.id}-stills.png`));
  }

  /** Add the picture that the film shows. */
  add() {
    const { film, line } = this.card;
    if (!film.isStill) return notice("the film is moving: pause it.", { bad: true });
    if (this.stills.length === STILLS_MAX) return notice(`a strip has at most ${STILLS_MAX} pictures.`, { bad: true });
    const filmS = film.times[film.index];
    const timeS = line.toSession(filmS);
    if (this.stills.some((still) => still.timeS === timeS)) return undefined;
    const { videoWidth: width, videoHeight: height } = film.element;
    const scale = Math.min(1, STILL.width / width, STILL.height / height);
    const picture = el("canvas", { width: Math.round(width * scale), height: Math.round(height * scale) });
    picture.getContext("2d").drawImage(film.element, 0, 0, picture.width, picture.height);
    this.stills.push({ timeS, picture, text: halfWidthText(line.halfWidth(filmS)) });
    this.stills.sort((a, b) => a.timeS - b.timeS);
    return this.draw();
  }

  /** Remove all: another film, or another alignment. */
  clear() {
    this.stills = [];
    this.draw();
  }

  draw() {
    byId("strip-card").hidden = !this.stills.length;
    byId("stills").replaceChildren(...this.stills.map((still) => {
      const remove = el("button", { type: "button", cls: "small", text: `${timeText(still.timeS, 1e-3)} ×`, "aria-label": `Remove the still at ${timeText(still.timeS, 1e-3)}` });
      remove.addEventListener("click", () => { this.stills = this.stills.filter((one) => one !== still); this.draw(); });
      return el("li", {}, remove);
    }));
    if (this.stills.length) quietly(() => this.drawPicture());
  }

  async drawPicture() {
    const { stills, page } = this;
    const view = around(stills[0].timeS - 0.1, stills.at(-1).timeS + 0.1, page.durationS);
    const bins = new Bins(await api.overview(page.session.id, { points: WIDTH / 2, start_s: view.from, end_s: view.to }), view);
    if (stills !== this.stills) return; // drawn again meanwhile
    const room = (WIDTH - GAP * (stills.length + 1)) / stills.length;
    const scale = Math.min(...stills.map(({ picture }) => Math.min(room / picture.width, STILL.height / picture.height, 1.5)));
    const high = Math.max(...stills.map(({ picture }) => picture.height)) * scale;
    const box = { left: LEFT, right: WIDTH - GAP, top: HEAD + high + TEXT + 56, bottom: HEAD + high + TEXT + 56 + CURVE };
    [this.canvas.width, this.canvas.height] = [WIDTH, Math.round(box.bottom + FOOT)];
    const context = this.canvas.getContext("2d");
    context.fillStyle = "#ffffff";
    context.fillRect(0, 0, WIDTH, this.canvas.height);
    context.fillStyle = INK;
    context.font = "700 20px system-ui, sans-serif";
    const { session } = page;
    context.fillText(printable(`${session.name}, ${session.node}, ${localTime(new Date(session.started_t_ns / 1e6))}`), GAP, 28, WIDTH - 2 * GAP);
    const x = this.drawCurve(context, bins, view, box);
    const step = Math.min(room + GAP, STILL.width * 1.5);
    stills.forEach(({ timeS, text, picture }, i) => {
      const middle = WIDTH / 2 + (i - (stills.length - 1) / 2) * step;
      const [width, height] = [picture.width * scale, picture.height * scale];
      context.drawImage(picture, middle - width / 2, HEAD, width, height);
      context.textAlign = "center";
      context.fillStyle = INK;
      context.font = "700 22px system-ui, sans-serif";
      context.fillText(timeText(timeS, 1e-3), middle, HEAD + high + 26);
      context.fillStyle = GREY;
      context.font = "500 17px system-ui, sans-serif";
      context.fillText(text, middle, HEAD + high + 49);
      context.strokeStyle = INK;
      context.lineWidth = 1.5;
      context.beginPath();
      for (const [atX, atY] of [[middle, HEAD + high + TEXT], [x(timeS), box.top - 8], [x(timeS), box.bottom]]) context.lineTo(atX, atY);
      context.stroke();
    });
    this.canvas.dataset.stills = String(stills.length);
  }

  /** Draw the force with its axes; return the place of an instant. */
  drawCurve(context, bins, view, box) {
    const found = bins.estimated ? bins.extremes("grf_low_n_min", "grf_high_n_max", 0, bins.count) ?? bins.extremes("grf_n_min", "grf_n_max", 0, bins.count) : null;
    const [low, high] = [Math.min(0, found?.low ?? 0), Math.max(1, 1.05 * (found?.high ?? 1))];
    const x = (timeS) => box.left + ((timeS - view.from) / (view.to - view.from)) * (box.right - box.left);
    const y = (force) => box.bottom - ((force - low) / (high - low)) * (box.bottom - box.top);
    context.font = "500 18px system-ui, sans-serif";
    context.lineWidth = 1;
    context.strokeStyle = GRID;
    const forces = ticks(low, high, 6);
    const times = ticks(view.from, view.to, 10);
    context.beginPath();
    for (const force of forces.values) { context.moveTo(box.left, y(force)); context.lineTo(box.right, y(force)); }
    for (const timeS of times.values) { context.moveTo(x(timeS), box.top); context.lineTo(x(timeS), box.bottom); }
    context.stroke();
    context.fillStyle = INK;
    context.textAlign = "right";
    if (found) for (const force of forces.values) context.fillText(number(force, decimalsOf(forces.step)), box.left - 8, y(force) + 6);
    context.textAlign = "center";
    for (const timeS of times.values) context.fillText(timeLabel(timeS, times.step), x(timeS), box.bottom + 24);
    context.fillText("Time, s", (box.left + box.right) / 2, box.bottom + 52);
    context.save();
    context.translate(24, (box.top + box.bottom) / 2);
    context.rotate(-Math.PI / 2);
    context.fillText(found ? "Ground reaction force, N" : "No forces here", 0, 0);
    context.restore();
    if (found) {
      context.save();
      context.beginPath();
      context.rect(box.left, box.top, box.right - box.left, box.bottom - box.top);
      context.clip();
      drawBand(context, bins, 0, bins.count, x, y, ["grf_low_n_min", "grf_high_n_max"], PALE);
      drawSeries(context, bins, 0, bins.count, x, y, ["grf_n_min", "grf_n_max"], BLUE, 2.5);
      context.restore();
    }
    context.strokeStyle = INK;
    context.strokeRect(box.left, box.top, box.right - box.left, box.bottom - box.top);
    return x;
  }
}
