// Strip of stills: pictures side by side with their instants, and the force below, white for print.

import * as api from "../common/api.js";
import { coloursOf } from "../common/axes.js";
import { notice, quietly } from "../common/notices.js";
import { byId, el, localTime, printable } from "../common/text.js";
import { Bins } from "./bins.js";
import { halfWidthText } from "./film_time.js";
import { timeText } from "./overlay.js";
import { panelsOf } from "./panels.js";
import { saveCanvas } from "./picture.js";
import { COLOURS, Plots } from "./plots.js";
import { around } from "./view.js";

const STILLS_MAX = 8;
const STILL = { width: 560, height: 480 }; // px, at most
const [WIDTH, GAP, HEAD, TEXT, LINES] = [1800, 12, 44, 58, 40]; // px
const CURVE = { ratio: 2, height: 170 }; // px of the plots

/** Return the colours of the plots as on paper, whatever the screen's are. */
function printColours() {
  const { dataset } = document.documentElement;
  const before = dataset.sunlight;
  dataset.sunlight = "true";
  const colours = coloursOf(byId("plots"), COLOURS);
  if (before === undefined) delete dataset.sunlight;
  else dataset.sunlight = before;
  return colours;
}

/** Force of a strip, drawn as on the page. */
class Curve extends Plots {
  constructor() { super(el("div"), el("canvas")); }

  get width() { return WIDTH / CURVE.ratio; }
  get ratio() { return CURVE.ratio; }
  scaled() { return CURVE.height; }
}

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
    this.stills = [...this.stills, { timeS, picture, text: halfWidthText(line.halfWidth(filmS)) }].sort((a, b) => a.timeS - b.timeS);
    return this.draw();
  }

  /** Remove all: another film, or another alignment. */
  clear() {
    this.stills = [];
    this.canvas.height = 0; // else the next strip shows old instants until it is drawn
    this.draw();
  }

  draw() {
    byId("strip-save", HTMLButtonElement).disabled = true; // until it is drawn
    byId("strip-card").hidden = !this.stills.length;
    byId("stills").replaceChildren(...this.stills.map((still) => {
      const remove = el("button", { type: "button", cls: "small", text: `${timeText(still.timeS, 1e-3)} ×`, "aria-label": `Remove the still at ${timeText(still.timeS, 1e-3)}` });
      remove.addEventListener("click", () => { this.stills = this.stills.filter((one) => one !== still); this.draw(); });
      return el("li", {}, remove);
    }));
    if (this.stills.length) quietly(() => this.drawPicture());
  }

  async drawPicture() {
    const { stills, page, page: { session, plots } } = this;
    const view = around(stills[0].timeS - 0.1, stills.at(-1).timeS + 0.1, page.durationS);
    const bins = new Bins(await api.overview(session.id, { points: WIDTH / 2, start_s: view.from, end_s: view.to }), view);
    if (stills !== this.stills) return; // drawn again meanwhile
    const curve = Object.assign(new Curve(), { whole: bins, panels: panelsOf(bins, false).slice(0, 1), stances: plots.stances, colours: printColours() });
    curve.draw(view);
    const room = (WIDTH - GAP * (stills.length + 1)) / stills.length;
    const scale = Math.min(1, ...stills.map(({ picture }) => room / picture.width));
    const textTop = HEAD + scale * Math.max(...stills.map(({ picture }) => picture.height));
    const curveTop = textTop + TEXT + LINES;
    const { box } = curve.drawn[0];
    [this.canvas.width, this.canvas.height] = [WIDTH, curveTop + curve.canvas.height];
    const context = this.canvas.getContext("2d");
    context.fillStyle = "#fff";
    context.fillRect(0, 0, WIDTH, this.canvas.height);
    context.drawImage(curve.canvas, 0, curveTop);
    context.fillStyle = context.strokeStyle = "#000";
    const write = (text, x, y, font) => {
      context.font = `${font} system-ui, sans-serif`;
      context.fillText(text, x, y, WIDTH - 2 * GAP);
    };
    write(printable(`${session.name}, ${session.node}, ${localTime(new Date(session.started_t_ns / 1e6))}`), GAP, 28, "700 20px");
    context.textAlign = "center";
    context.lineWidth = 1.5;
    stills.forEach(({ timeS, text, picture }, i) => {
      const middle = WIDTH / 2 + (i - (stills.length - 1) / 2) * (Math.min(room, STILL.width * 1.5) + GAP);
      context.drawImage(picture, middle - (scale * picture.width) / 2, HEAD, scale * picture.width, scale * picture.height);
      write(timeText(timeS, 1e-3), middle, textTop + 26, "700 22px");
      write(text, middle, textTop + 49, "500 17px");
      const x = CURVE.ratio * curve.x(view)(timeS);
      context.beginPath();
      for (const [atX, atY] of [[middle, textTop + TEXT], [x, curveTop], [x, curveTop + CURVE.ratio * box.bottom]]) context.lineTo(atX, atY);
      context.stroke();
    });
    this.canvas.dataset.stills = String(stills.length);
    byId("strip-save", HTMLButtonElement).disabled = false;
  }
}
