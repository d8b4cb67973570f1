// Live page: one state, messages in, one drawing per display frame.
//
// common/    REST calls, websocket, dialogs, notices, texts and elements
// live/      panels that draw the latest frame, and the action buttons
// nodes/     page of all nodes
// calibrate/ page of the guided calibration
// sessions/  page of recorded sessions, and the trash
//
// A panel is a class that owns one element of index.html. This module creates it and passes server
// messages to it. Panels do not import each other. No build step, no file from another host.

import { addDeviceMenu } from "./common/device.js";
import { Link } from "./common/link.js";
import { LOSSES_HELP } from "./common/losses.js";
import { look } from "./common/login.js";
import { quietly } from "./common/notices.js";
import { ReplacementWarning } from "./common/replacement.js";
import { loadModule } from "./common/request.js";
import { Trials } from "./common/trials.js";
import { inSunlight } from "./common/sunlight.js";
import { byId, el, setText } from "./common/text.js";
import { Actions } from "./live/actions.js";
import { Bars } from "./live/bars.js";
import { Foot } from "./live/foot.js";
import { helpWithKeys } from "./common/help.js";
import { drawGrf } from "./live/grf.js";
import { History } from "./live/history.js";
import { LastSession } from "./live/last_session.js";
import { MarkerQueue } from "./live/markers.js";
import { Notes } from "./live/notes.js";
import { FramePace, Pace } from "./live/pace.js";
import { Pause } from "./live/pause.js";
import { Range } from "./live/range.js";
import { Status } from "./live/status.js";
import { Tares } from "./live/tares.js";
import { TileTraces } from "./live/tile_traces.js";
import { Trace } from "./live/trace.js";

const NODE_KEY = "foottile.node";

const state = {
  nodes: new Map(),
  problems: [], // damaged files on the server
  requested: null, // name of the node to show: survives a restart of the server
  node: null, // selected node, as the server last described it
  frame: null, // latest frame of the selected node; min-max merged since the last drawing
  fresh: false, // `frame` has not been drawn yet
  received: { frameMs: null, heartbeat: null, sinceMs: performance.now() },
  recordings: new Map(),
  cannotRecord: "", // reason why a recording or a tare would be refused now
  serverNowMs: () => link.serverNowMs(),
};

inSunlight();
const trials = new Trials(() => link.serverNowMs(), () => state.cannotRecord);
const watchers = addDeviceMenu(trials);
const framePace = new FramePace();
const pace = new Pace(draw);
const redraw = () => {
  state.fresh = true;
  framePace.reset();
  pace.request();
};
const range = new Range(byId("range"), redraw);
const bars = new Bars(redraw, range);
const foot = new Foot(range);
foot.resized = redraw;
const trace = new Trace(() => { history.request(); pace.request(); });
const tileTraces = new TileTraces(range, () => { redraw(); trace.recolour(); });
const history = new History(trace.points, () => state.node?.stream_id);
const pause = new Pause(() => {
  if (pause.held) trace.pause(pause.held.nowMs);
  else trace.resume();
  redraw();
});
pause.latest = () => state.frame;
helpWithKeys(LOSSES_HELP);
const notes = new Notes();
const replacement = new ReplacementWarning();
byId("replacement-box").append(replacement.element);
const lastSession = new LastSession();
const tares = new Tares();
const markers = new MarkerQueue();
const actions = new Actions(state, markers, updateSession);

/** @type {import("./common/link.js").Handlers} */
const handlers = {
  hello(message) {
    state.nodes = new Map((message.nodes ?? []).map((node) => [node.node, node]));
    state.problems = message.problems ?? [];
    state.recordings.clear();
    history.request(); // frames sent while the link was down
    (message.recording ?? []).forEach(updateSession);
    lastSession.clear(); // may be another server
    selectNode();
    markers.send(); // the server is back
    look(); // the login may have ended
  },
  node({ node }) {
    const isNew = !state.nodes.has(node.node);
    const previousStreamId = state.nodes.get(node.node)?.stream_id;
    state.nodes.set(node.node, node);
    if (state.node?.node === node.node) {
      if (previousStreamId !== node.stream_id) clearFrames(); // new stream: the old trace does not continue
      state.node = node;
      show();
    }
    if (isNew || !state.node) selectNode();
  },
  session: ({ session }) => updateSession(session),
  session_progress: ({ sessions: counts }) => Object.entries(counts).forEach(([id, progress]) => updateProgress(id, progress)),
  deleted: ({ session_id: id }) => removeSession(id),
  heartbeat(message) {
    state.received.heartbeat = message.nodes?.[state.node?.node] ?? null;
  },
  frame(message) {
    if (message.node === state.node?.node) receiveFrame(message);
  },
};

const link = new Link({ handlers, watchers });
const status = new Status(link);

function receiveFrame(frame) {
  const nowMs = performance.now();
  if (state.fresh && state.frame && !document.hidden) mergeSpan(frame, state.frame); // two messages, one drawing: both peaks count
  state.frame = frame;
  show();
  state.received.frameMs = nowMs;
  status.addFrame(frame);
  notes.addFrame(state.node, frame, nowMs);
  trace.add(frame, state.node.nominal_rate_hz, nowMs);
  history.update(state.node, frame, trace.windowS, nowMs, tileTraces.column(bars.unit));
}

function show() {
  state.fresh = true;
  pace.request();
}

/** Widen min and max of a frame by those of an earlier one. */
function mergeSpan(frame, earlier) {
  const wider = (now, before, pick) => now?.map((value, i) => {
    const old = before?.[i];
    return Number.isFinite(value) && Number.isFinite(old) ? pick(value, old) : value;
  });
  for (const name of ["gauge_min_kpa", "force_min_n"]) frame[name] = wider(frame[name], earlier[name], Math.min);
  for (const name of ["gauge_max_kpa", "force_max_n"]) frame[name] = wider(frame[name], earlier[name], Math.max);
}

function updateSession(session) {
  if (session.state === "recording") state.recordings.set(session.id, session);
  else state.recordings.delete(session.id);
  lastSession.update(session);
  actions.draw();
}

/** Copy progress from the server: only its ledger counts frames. */
function updateProgress(id, progress) {
  const session = state.recordings.get(id);
  if (session) state.recordings.set(id, { ...session, ...progress });
}

function removeSession(id) {
  state.recordings.delete(id);
  lastSession.drop(id);
  actions.draw();
}

function clearFrames() {
  state.frame = null;
  state.received = { frameMs: null, heartbeat: null, sinceMs: performance.now() };
  pause.resume();
  trace.clear();
  history.request();
  notes.clear();
  status.clear();
}

function storedNode() {
  try { return localStorage.getItem(NODE_KEY); } catch { return null; }
}

/** Select the requested node, else the stored one, else a connected one. */
function selectNode(requested = state.requested ?? storedNode()) {
  const all = [...state.nodes.values()];
  const next = state.nodes.get(requested) ?? all.find((node) => node.connected) ?? all[0] ?? null;
  if (next?.node !== state.node?.node || next?.stream_id !== state.node?.stream_id) clearFrames();
  state.node = next;
  state.requested = requested ?? next?.node ?? null;
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
  selectNode(chosen);
});

byId("calibration").addEventListener("click", () => quietly(async () => {
  const { openCalibration } = await loadModule(() => import("./common/calibration.js"));
  if (state.node) await openCalibration(state.node);
}));

/** Update live or frozen state and counters, also while the tab draws nothing. */
function tick() {
  const { node } = state;
  const hasData = link.open || node;
  byId("empty").hidden = Boolean(node) || !hasData;
  document.body.dataset.nodes = String(state.nodes.size);
  byId("node-choice").hidden = state.nodes.size < 2;
  byId("node-name").hidden = state.nodes.size >= 2;
  setText(byId("node-name"), node?.node ?? "");
  byId("status").hidden = !node;
  byId("emulated").hidden = !node?.emulated;
  document.body.dataset.emulated = String(Boolean(node?.emulated));
  const nowMs = performance.now();
  // Without a node the banner still states that the server is down.
  status.draw(node ?? { node: "?", tiles: [] }, state.received, nowMs, state.serverNowMs());
  state.cannotRecord = node ? status.cannotRecord : "";
  // Without any live data, recordings come first.
  const isAway = Boolean(node) && link.open && !node.connected && status.isBlank;
  byId("away").hidden = !isAway;
  byId("live").hidden = isAway || (!node && Boolean(hasData));
  setText(byId("away-title"), isAway ? `Node ${node.node} is offline` : "");
  document.body.dataset.away = String(isAway);
  notes.draw(node, state.frame, nowMs, state.serverNowMs(), state.problems);
  replacement.draw(node);
  tares.draw(node);
  byId("calibration-line").hidden = !node;
  setText(byId("calibration-name"), node?.calibration ? `Calibration “${node.calibration.name}”` : "No calibration");
  actions.draw();
  trials.draw();
  lastSession.draw(node);
  if (node && !node.connected) history.update(node, null, trace.windowS, nowMs, tileTraces.column(bars.unit));
}

function draw() {
  const { node } = state;
  if (!node) return;
  const nowMs = performance.now();
  const { frame, nowMs: shownMs } = pause.held ?? { frame: state.frame, nowMs };
  const isDue = framePace.isDue(node, frame, nowMs);
  if (state.fresh || isDue) {
    state.fresh = false;
    if (!tileTraces.shown) bars.draw(node, frame, shownMs, isDue);
    if (!isDue) foot.noteCop(node, frame);
  }
  if (isDue) { // all numbers, and the foot that contains some, are of one frame
    foot.draw(node, frame, bars.shown);
    drawGrf(node, frame);
  }
  const drawn = trace.draw(nowMs, status.live);
  if (drawn) tileTraces.draw(node, drawn, nowMs, bars.unit);
}

setText(byId("start-command"), `foottile node --scene FILE --server ${location.origin}`);
setInterval(tick, 100);
tick();
pace.request();
