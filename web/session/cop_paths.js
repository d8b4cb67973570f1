// COP paths of several stances on the foot (butterfly diagram).

import { fit } from "../common/axes.js";
import { FootLayout } from "../common/foot_layout.js";
import { drawCurve, drawFrame, FONT } from "../common/frame.js";
import { byId, el, printable, setData, setText } from "../common/text.js";

const HIT_PX = 14;
const PLAN_PX = 420;
const SIDE_PX = 320;
const SHADES = 24; // of time or stances; finer steps are invisible

/** Plot of the COP paths. */
export class CopPaths {
  /** @param {() => void} onChange @param {(curve: {number: number}) => void} onGo */
  constructor(onChange, onGo) {
    this.canvas = byId("cop-canvas", HTMLCanvasElement);
    this.by = "time";
    for (const button of /** @type {NodeListOf<HTMLButtonElement>} */ (document.querySelectorAll("#cop-colour button"))) {
      button.addEventListener("click", () => { this.by = button.value; onChange(); });
    }
    this.canvas.addEventListener("click", (event) => {
      const curve = this.nearest(event.offsetX, event.offsetY);
      if (curve) onGo(curve);
    });
    this.canvas.addEventListener("pointermove", (event) => {
      this.canvas.style.cursor = this.nearest(event.offsetX, event.offsetY) ? "pointer" : "";
    });
  }

  /** @param {TileView[]} tiles */
  show(tiles, answer) {
    this.tiles = tiles;
    this.answer = answer;
    this.known = answer.curves.some((curve) => [...curve.cop_x_m, ...curve.cop_y_m].some((value) => value !== null));
    byId("cop-figure").hidden = !this.known;
  }

  /**
   * @param {{number: number} | null} chosen
   * @param {{percent: number[], copX: (number | null)[], copY: (number | null)[]} | null} frames of the selected stance
   * @param {CurveView | null | undefined} hovered
   * @param {{percent: number[], overlaid: number, spread: object} | null} beside overlay of another session
   */
  draw(colours, chosen, frames, hovered, beside = null) {
    const width = this.canvas.parentElement.clientWidth;
    if (!this.known || width < 100) return;
    const { plan, place } = this.layOut(width, colours);
    setText(byId("cop-title"), plan ? "COP on the foot, from above" : "COP along the foot, over the stance");
    setData(this.canvas, "plan", String(plan));
    const { context } = this;
    const { curves, points } = this.answer;
    const percent = Array.from({ length: points }, (_, i) => (100 * i) / (points - 1));
    this.drawn = curves.map((curve) => ({ curve, places: placesOf(percent, curve.cop_x_m, curve.cop_y_m, place) }));
    const shade = shadesOf(colours);
    context.lineJoin = context.lineCap = "round";
    context.lineWidth = 1.25;
    context.globalAlpha = chosen ? 0.3 : Math.max(0.35, Math.min(1, 12 / curves.length));
    if (this.by === "time") this.drawByTime(this.drawn.map(({ places }) => places), percent, shade);
    else {
      this.drawn.forEach(({ places }, i) => {
        context.strokeStyle = shade(i / Math.max(1, curves.length - 1));
        drawCurve(context, ...places);
      });
    }
    context.globalAlpha = 1;
    const bold = (places, along, colour) => {
      context.lineWidth = 7;
      context.strokeStyle = colours.page;
      drawCurve(context, ...places);
      context.lineWidth = 3.5;
      context.strokeStyle = colour;
      if (along && this.by === "time") this.drawByTime([places], along, shade);
      else drawCurve(context, ...places);
      this.drawEnds(places, colours);
    };
    if (hovered) {
      context.lineWidth = 2.5;
      context.strokeStyle = colours.text;
      drawCurve(context, ...placesOf(percent, hovered.cop_x_m, hovered.cop_y_m, place));
    }
    if (beside) {
      context.lineWidth = 3;
      context.strokeStyle = colours.other;
      drawCurve(context, ...placesOf(beside.percent, ...meanOf(beside), place));
    }
    if (frames) bold(placesOf(frames.percent, frames.copX, frames.copY, place), frames.percent, colours.cop);
    else bold(placesOf(percent, ...meanOf(this.answer), place), null, colours.text);
    this.drawLegend(chosen, frames);
  }

  layOut(width, colours) {
    const layout = new FootLayout(this.tiles, { widthPx: width, heightPx: PLAN_PX, roomPx: 60, toesUp: true });
    const height = layout.plan ? PLAN_PX : SIDE_PX;
    this.canvas.style.height = `${height}px`;
    const context = this.context = fit(this.canvas, width, height);
    context.font = FONT;
    if (layout.plan) {
      this.drawTiles(layout.points, layout.radiusPx, colours);
      this.drawScale(layout, width, height, colours);
      const place = (_, xM, yM) => {
        const found = layout.copPlace(xM, yM);
        return found && layout.at(found.x, found.y);
      };
      return { plan: true, place };
    }
    // A line of tiles measures one axis: the other is time.
    const radius = Math.min(11, 0.42 * layout.pitch * ((width - 60) / (layout.span + 2 * layout.pitch)));
    const box = { left: 46, right: width - 14, top: 24, bottom: height - 74 };
    const xs = this.tiles.map((tile) => 1e3 * tile.x_m);
    const margin = 1e3 * layout.pitch;
    const { x, y } = drawFrame(context, box, {
      x: { low: Math.min(...xs) - margin, high: Math.max(...xs) + margin }, y: { low: 0, high: 100 },
      colours, xUnit: "mm", yTitle: "% of stance",
    });
    const points = this.tiles.map((tile) => ({ x: x(1e3 * tile.x_m), y: box.bottom + 40 }));
    this.drawTiles(points, Math.max(4, radius), colours);
    context.fillStyle = colours.soft;
    context.textAlign = "right";
    context.fillText("forward →", box.right, box.bottom + 62);
    return { plan: false, place: (percent, xM) => (xM === null ? null : { x: x(1e3 * xM), y: y(percent) }) };
  }

  drawTiles(points, radius, colours) {
    const { context, tiles } = this;
    context.lineWidth = 1.5;
    context.textAlign = "center";
    context.textBaseline = "middle";
    points.forEach((point, i) => {
      context.strokeStyle = colours.edge;
      context.setLineDash(tiles[i].reference ? [3, 3] : []);
      context.beginPath();
      context.arc(point.x, point.y, radius, 0, 7);
      context.stroke();
      context.fillStyle = colours.soft;
      if (radius >= 13) context.fillText(printable(tiles[i].serial), point.x, point.y);
    });
    context.setLineDash([]);
  }

  /** Draw direction and a 10 mm scale bar. */
  drawScale(layout, width, height, colours) {
    const { context } = this;
    context.fillStyle = colours.soft;
    context.textBaseline = "top";
    context.textAlign = "right";
    context.fillText("toes ↑", width - 8, 6);
    const long = 0.01 * layout.scale;
    const [left, top] = [14, height - 12];
    context.strokeStyle = colours.text;
    context.lineWidth = 2;
    context.beginPath();
    context.moveTo(left, top - 4);
    context.lineTo(left, top);
    context.lineTo(left + long, top);
    context.lineTo(left + long, top - 4);
    context.stroke();
    context.textAlign = "left";
    context.textBaseline = "bottom";
    context.fillText("10 mm", left, top - 6);
  }

  /** Draw all paths shade by shade, so that strokes are few. */
  drawByTime(paths, along, shade) {
    const { context } = this;
    for (let one = 0; one < SHADES; one++) {
      context.strokeStyle = shade((one + 0.5) / SHADES);
      context.beginPath();
      for (const [xs, ys] of paths) {
        let last = -2;
        for (let i = 0; i + 1 < along.length; i++) {
          if (Math.min(SHADES - 1, Math.floor((along[i] / 100) * SHADES)) !== one || ys[i] === null || ys[i + 1] === null) continue;
          if (last !== i) context.moveTo(xs[i], ys[i]);
          context.lineTo(xs[i + 1], ys[i + 1]);
          last = i + 1;
        }
      }
      context.stroke();
    }
  }

  /** Draw a ring at the start and a dot at the end of a path. */
  drawEnds([xs, ys], colours) {
    const { context } = this;
    const first = ys.findIndex((value) => value !== null);
    const last = ys.findLastIndex((value) => value !== null);
    if (first < 0) return;
    context.lineWidth = 2;
    context.strokeStyle = colours.text;
    for (const [i, fill] of [[first, colours.page], [last, colours.text]]) {
      context.fillStyle = fill;
      context.beginPath();
      context.arc(xs[i], ys[i], 4.5, 0, 7);
      context.fill();
      context.stroke();
    }
  }

  drawLegend(chosen, frames) {
    for (const button of /** @type {NodeListOf<HTMLButtonElement>} */ (document.querySelectorAll("#cop-colour button"))) button.setAttribute("aria-pressed", String(button.value === this.by));
    const what = this.by === "time" ? ["first contact", "lift-off"] : ["first stance", "last stance"];
    const items = [
      ["shades", `${what[0]} to ${what[1]}`],
      ["ends", `○ start, ● end: ${frames ? `stance ${chosen.number}` : "mean, where half of the stances have a COP"}`],
    ];
    const list = byId("cop-legend");
    const key = JSON.stringify(items);
    if (list.dataset.key === key) return;
    list.dataset.key = key;
    list.replaceChildren(...items.map(([name, text]) =>
      el("li", { "data-kind": name }, ...(name === "shades" ? [el("i", { cls: "swatch over-shades", "aria-hidden": "true" })] : []), text)));
  }

  nearest(px, py) {
    let best = { away: HIT_PX, curve: null };
    for (const { curve, places: [xs, ys] } of this.drawn ?? []) {
      for (let i = 0; i < xs.length; i++) {
        if (ys[i] === null) continue;
        const away = Math.hypot(xs[i] - px, ys[i] - py);
        if (away < best.away) best = { away, curve };
      }
    }
    return best.curve;
  }
}

/** Return the mean path where at least half of the stances have a COP: with fewer it would jump. */
const meanOf = ({ overlaid, spread }) =>
  [spread.cop_x_m, spread.cop_y_m].map(({ mean, count }) => mean.map((value, i) => (2 * count[i] >= overlaid ? value : null)));

function placesOf(along, xsM, ysM, place) {
  const [xs, ys] = [[], []];
  for (let i = 0; i < along.length; i++) {
    const at = place(along[i], xsM[i], ysM[i]);
    xs.push(at?.x ?? null);
    ys.push(at?.y ?? null);
  }
  return [xs, ys];
}

/** Return a function from a share to a colour of the style sheet's heat scale. */
function shadesOf(colours) {
  const stops = ["heat-1", "heat-2", "heat-3"].map((name) => rgbOf(colours[name]));
  return (share) => {
    const at = Math.min(1, Math.max(0, share)) * (stops.length - 1);
    const i = Math.min(stops.length - 2, Math.floor(at));
    const mixed = stops[i].map((value, part) => Math.round(value + (at - i) * (stops[i + 1][part] - value)));
    return `rgb(${mixed.join(" ")})`;
  };
}

const rgbOf = (hex) => [1, 3, 5].map((at) => Number.parseInt(hex.slice(at, at + 2), 16));
