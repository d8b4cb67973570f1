// Ties the page together: one state, messages in, one drawing per display frame.
//
// common/    REST calls, the websocket, dialogs, notices, words and elements
// live/      panels that draw the newest frame, and the buttons beside them
// nodes/     the page of all nodes
// calibrate/ the page of the guided calibration
// sessions/  the page of recorded sessions, and the trash
//
// A panel is a class that owns one element of index.html; it is made here and handed what the
// server says. Panels do not know each other. No build step, and nothing from another host.

import { Link } from "./common/link.js";
import { look } from "./common/login.js";
import { quietly } from "./common/notices.js";
import { ReplacementWarning } from "./common/replacement.js";
import { loadModule } from "./common/request.js";
import { inSunlight } from "./common/sunlight.js";
import { byId, el, setText } from "./common/text.js";
import { Actions } from "./live/actions.js";
import { Bars } from "./live/bars.js";
import { Foot } from "./live/foot.js";
import { helpWithKeys } from "./common/help.js";
import { drawGrf } from "./live/grf.js";
import { History } from "./live/history.js";
import { LastSession } from "./live/last_session.js";
import { Marks } from "./live/marks.js";
import { Notes } from "./live/notes.js";
import { Pace, Reading } from "./live/pace.js";
import { Pause } from "./live/pause.js";
import { Range } from "./live/range.js";
import { Status } from "./live/status.js";
import { Tares } from "./live/tares.js";
import { TileTraces } from "./live/tile_traces.js";
import { Trace } from "./live/trace.js";

const NODE_KEY = "foottile.node";

const state = {
  nodes: new Map(),
  problems: [], // what the server found damaged on its disk
  wanted: null, // name of the node to show: survives a restart of the server
  node: null, // the chosen one, as the server last described it
  frame: null, // the newest frame of the chosen node; spans merged since the last drawing
  fresh: false, // `frame` has not been drawn yet
  heard: { frameMs: null, beat: null, sinceMs: performance.now() },
  recordings: new Map(),
  cannotRecord: "", // why a recording or a tare would be refused now
  serverAheadMs: 0,
  serverNowMs: () => Date.now() + state.serverAheadMs,
};

inSunlight();
const reading = new Reading();
const pace = new Pace(draw);
const again = () => {
  state.fresh = true;
  reading.again();
  pace.ask();
};
const range = new Range(byId("range"), again);
const bars = new Bars(again, range);
const foot = new Foot(range);
foot.resized = again;
const trace = new Trace(() => { past.want(); pace.ask(); });
const tileTraces = new TileTraces(range, () => { again(); trace.recolour(); });
const past = new History(trace.points, () => state.node?.boot_id);
const pause = new Pause(() => {
  if (pause.held) trace.pause(pause.held.nowMs);
  else trace.goOn();
  again();
});
pause.newest = () => state.frame;
helpWithKeys();
const notes = new Notes();
const replacement = new ReplacementWarning();
byId("replacement-box").append(replacement.element);
const lastSession = new LastSession();
const tares = new Tares();
const marks = new Marks();
const actions = new Actions(state, marks, takeSession);

const handlers = {
  hello(message) {
    state.nodes = new Map((message.nodes ?? []).map((node) => [node.node, node]));
    state.problems = message.problems ?? [];
    state.recordings.clear();
    past.want(); // what came while the link was down
    (message.recording ?? []).forEach(takeSession);
    lastSession.clear(); // another server may have others
    chooseNode();
    marks.send(); // the server is back
    look(); // and may know us no more
  },
  node({ node }) {
    const isNew = !state.nodes.has(node.node);
    const wasBoot = state.nodes.get(node.node)?.boot_id;
    state.nodes.set(node.node, node);
    if (state.node?.node === node.node) {
      if (wasBoot !== node.boot_id) forget(); // it restarted: the old trace is another story
      state.node = node;
      show();
    }
    if (isNew || !state.node) chooseNode();
  },
  session: ({ session }) => takeSession(session),
  counted: ({ sessions: counts }) => Object.entries(counts).forEach(([id, counted]) => count(id, counted)),
  deleted: ({ session_id: id }) => forgetSession(id),
  heartbeat(message) {
    state.heard.beat = message.nodes?.[state.node?.node] ?? null;
  },
  frame(message) {
    if (message.node === state.node?.node) takeFrame(message);
  },
};

const link = new Link({
  onMessage(message) {
    if (Number.isFinite(message.t_ns) && ["hello", "heartbeat", "pong"].includes(message.type)) {
      // What has come was sent half a round trip ago.
      state.serverAheadMs = message.t_ns / 1e6 + (link.roundTripMs ?? 0) / 2 - Date.now();
    }
    // Unknown types are a newer server's business.
    if (Object.hasOwn(handlers, message.type)) handlers[message.type](message);
  },
  onChange: () => {},
});
const status = new Status(link);

function takeFrame(frame) {
  const nowMs = performance.now();
  if (state.fresh && state.frame && !document.hidden) keepSpan(frame, state.frame); // two messages, one drawing: keep both peaks
  state.frame = frame;
  show();
  state.heard.frameMs = nowMs;
  status.see(frame);
  notes.see(state.node, frame, nowMs);
  trace.add(frame, state.node.nominal_rate_hz, nowMs);
  past.see(state.node, frame, trace.windowS, nowMs, tileTraces.wants(bars.unit));
}

function show() {
  state.fresh = true;
  pace.ask();
}

function keepSpan(frame, earlier) {
  const wider = (now, before, pick) => now?.map((value, i) => {
    const old = before?.[i];
    return Number.isFinite(value) && Number.isFinite(old) ? pick(value, old) : value;
  });
  for (const name of ["gauge_min_kpa", "force_min_n"]) frame[name] = wider(frame[name], earlier[name], Math.min);
  for (const name of ["gauge_max_kpa", "force_max_n"]) frame[name] = wider(frame[name], earlier[name], Math.max);
}

function takeSession(session) {
  if (session.state === "recording") state.recordings.set(session.id, session);
  else state.recordings.delete(session.id);
  lastSession.take(session);
  actions.draw();
}

/** Frames are counted by the server's ledger alone; here its word is shown. */
function count(id, counted) {
  const session = state.recordings.get(id);
  if (session) state.recordings.set(id, { ...session, ...counted });
}

function forgetSession(id) {
  state.recordings.delete(id);
  lastSession.drop(id);
  actions.draw();
}

function forget() {
  state.frame = null;
  state.heard = { frameMs: null, beat: null, sinceMs: performance.now() };
  pause.goOn();
  trace.clear();
  past.want();
  notes.clear();
  status.clear();
}

function kept() {
  try { return localStorage.getItem(NODE_KEY); } catch { return null; }
}

/** Keep the choice; else the remembered node, else one that is there. */
function chooseNode(wanted = state.wanted ?? kept()) {
  const all = [...state.nodes.values()];
  const next = state.nodes.get(wanted) ?? all.find((node) => node.connected) ?? all[0] ?? null;
  if (next?.node !== state.node?.node || next?.boot_id !== state.node?.boot_id) forget();
  state.node = next;
  state.wanted = wanted ?? next?.node ?? null;
  show();
  const select = byId("node-select", HTMLSelectElement);
  const names = all.map((node) => node.node).sort();
  if (names.join("\n") !== [...select.options].map((option) => option.value).join("\n")) {
    select.replaceChildren(...names.map((name) => el("option", { value: name, text: name })));
  }
  if (next) select.value = next.node;
}

byId("node-select").addEventListener("change", () => {
  const chosen = byId("node-select", HTMLSelectElement).value;
  try { localStorage.setItem(NODE_KEY, chosen); } catch { /* private window */ }
  chooseNode(chosen);
});

byId("calibration").addEventListener("click", () => quietly(async () => {
  const { openCalibration } = await loadModule(() => import("./common/calibration.js"));
  if (state.node) await openCalibration(state.node);
}));

/** What must also be right while the tab draws nothing: live or frozen, and the counters. */
function tick() {
  const { node } = state;
  const reached = link.open || node;
  byId("empty").hidden = Boolean(node) || !reached;
  document.body.dataset.nodes = String(state.nodes.size);
  byId("node-choice").hidden = state.nodes.size < 2;
  byId("node-name").hidden = state.nodes.size >= 2;
  setText(byId("node-name"), node?.node ?? "");
  byId("status").hidden = !node;
  byId("emulated").hidden = !node?.emulated;
  document.body.dataset.emulated = String(Boolean(node?.emulated));
  const nowMs = performance.now();
  // The chosen node may not be known yet: the banner still says that the server is not there.
  status.draw(node ?? { node: "?", tiles: [] }, state.heard, nowMs, state.serverNowMs());
  state.cannotRecord = node ? status.cannotRecord : "";
  // Without a picture of any age, what was recorded comes first.
  const isAway = Boolean(node) && link.open && !node.connected && status.isBlank;
  byId("away").hidden = !isAway;
  byId("live").hidden = isAway || (!node && Boolean(reached));
  setText(byId("away-title"), isAway ? `Node ${node.node} is away` : "");
  document.body.dataset.away = String(isAway);
  notes.draw(node, state.frame, nowMs, state.serverNowMs(), state.problems);
  replacement.draw(node);
  tares.draw(node);
  byId("calibration-line").hidden = !node;
  setText(byId("calibration-name"), node?.calibration ? `Calibration “${node.calibration.name}”` : "No calibration");
  actions.draw();
  lastSession.draw(node);
  if (node && !node.connected) past.see(node, null, trace.windowS, nowMs, tileTraces.wants(bars.unit));
}

function draw() {
  const { node } = state;
  if (!node) return;
  const nowMs = performance.now();
  const { frame, nowMs: shownMs } = pause.held ?? { frame: state.frame, nowMs };
  const isRead = reading.isDue(node, frame, nowMs);
  if (state.fresh || isRead) {
    state.fresh = false;
    if (!tileTraces.shown) bars.draw(node, frame, shownMs, isRead);
    foot.draw(node, frame, isRead);
    if (isRead) drawGrf(node, frame);
  }
  const drawn = trace.draw(nowMs, status.live);
  if (drawn) tileTraces.draw(node, drawn, nowMs, bars.unit);
}

setText(byId("start-command"), `foottile node --scene FILE --server ${location.origin}`);
setInterval(tick, 100);
tick();
pace.ask();
