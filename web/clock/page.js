// Clock page: the server's time as squares, to be filmed, so that a film can be aligned with a session.

import { Awake } from "../common/awake.js";
import { Link } from "../common/link.js";
import { byId, number, setText } from "../common/text.js";
import { cellsOf, drawCode, Offset, statedMs, TICK_MS, UNITS, UNKNOWN_MS } from "./code.js";

const INTERVALS = 60; // of the screen's refresh
const canvas = byId("code", HTMLCanvasElement);
const offset = new Offset();
const intervalsMs = [];
let lastMs = null;

const link = new Link({
  handlers: {
    pong: ({ t_ms: sentMs, t_ns: serverNs }) => offset.note(sentMs, serverNs * 1e-6, performance.now()),
  },
  onChange: () => { if (!link?.open) offset.best = null; },
  rateHz: 1,
});
const awake = new Awake(write);
awake.chosen = true; // here without being asked
awake.hold();

/** Return the interval of the screen's refresh, the median. */
function refreshMs() {
  if (intervalsMs.length < INTERVALS / 2) return NaN;
  return [...intervalsMs].sort((a, b) => a - b)[intervalsMs.length >> 1];
}

/** Fit the canvas to its box in whole pixels of the screen; on a phone that is held upright the page lies on its side. */
function fitCanvas() {
  const { clientWidth: width, clientHeight: height } = byId("code-box");
  const ratio = devicePixelRatio || 1;
  const isUpright = height > width;
  const [across, down] = isUpright ? [UNITS.down, UNITS.across] : [UNITS.across, UNITS.down];
  const unit = Math.max(1, Math.floor(Math.min((width * ratio) / across, (height * ratio) / down)));
  if (canvas.width !== unit * across || canvas.height !== unit * down) {
    [canvas.width, canvas.height] = [unit * across, unit * down];
    canvas.style.width = `${canvas.width / ratio}px`;
    canvas.style.height = `${canvas.height / ratio}px`;
  }
  const context = canvas.getContext("2d");
  if (isUpright) context.setTransform(0, unit, -unit, 0, canvas.width, 0);
  else context.setTransform(unit, 0, 0, unit, 0, 0);
  return context;
}

/**
 * Draw the time of this drawing. It is seen later: a browser queues one to three refreshes, and the panel takes 5 to 15 ms.
 * What reads the film adds this latency and states it, so it is not added here.
 */
function draw(frameMs) {
  requestAnimationFrame(draw);
  if (lastMs !== null && frameMs > lastMs) intervalsMs.push(frameMs - lastMs);
  lastMs = frameMs;
  if (intervalsMs.length > INTERVALS) intervalsMs.shift();
  const nowMs = performance.now();
  drawCode(fitCanvas(), cellsOf(offset.best ? nowMs + offset.best.aheadMs : 0, statedMs(offset.boundMs(nowMs)), statedMs(refreshMs())));
}

/** Write how good this clock is. */
function write() {
  const [boundMs, screenMs] = [statedMs(offset.boundMs(performance.now())), refreshMs()];
  const isSlow = screenMs > TICK_MS;
  const isUnknown = boundMs === UNKNOWN_MS || Number.isNaN(screenMs);
  document.body.dataset.ready = String(!isUnknown && !isSlow);
  setText(byId("what"), isUnknown ? "Wait: the server's time is being measured." : isSlow ? "Do not film this: the screen changes too rarely. Use another device, or end its energy saving." : "Film this for two seconds.");
  setText(byId("how"), [
    boundMs === UNKNOWN_MS ? "Server's time unknown" : `Server's time ± ${boundMs} ms`,
    Number.isNaN(screenMs) ? "" : `screen ${number(1e3 / screenMs, 0)} Hz`, awake?.state ?? "",
  ].filter(Boolean).join(", "));
}

const full = byId("full");
full.hidden = !full.requestFullscreen;
full.addEventListener("click", () => document.querySelector("main").requestFullscreen().catch(() => full.remove()));
setInterval(write, 500);
requestAnimationFrame(draw);
