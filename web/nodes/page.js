// Page of all nodes: one card each, and recordings on all of them.

import { addDeviceMenu } from "../common/device.js";
import { helpWithKeys } from "../common/help.js";
import { Link } from "../common/link.js";
import { LOSSES_HELP } from "../common/losses.js";
import { look } from "../common/login.js";
import { inSunlight } from "../common/sunlight.js";
import { byId, setText } from "../common/text.js";
import { Trials } from "../common/trials.js";
import { Card } from "./card.js";
import { Takes } from "./take.js";

const RATE_HZ = 10; // saves a phone's battery
const EVERY_MS = 200;

const cards = new Map(); // by name of the node
const recordings = new Map(); // by id of the session

const takes = new Takes({
  recordings,
  cannotRecord: () => (!link.open ? "The server link is down." : [...cards.values()].some(({ node }) => node.connected) ? "" : "No node is connected."),
  serverNowMs: () => link.serverNowMs(),
  onSession: updateSession,
  connected: () => [...cards.values()].map(({ node }) => node).filter((node) => node.connected).map((node) => node.node),
  onRefused: (action, failed) => cards.forEach((card, name) => { card.refused = failed[name] ? `${action}: ${failed[name]}` : ""; }),
});

/** @type {import("../common/link.js").Handlers} */
const handlers = {
  hello(message) {
    const names = new Set((message.nodes ?? []).map((node) => node.node));
    for (const name of cards.keys()) if (!names.has(name)) cards.delete(name);
    (message.nodes ?? []).forEach(updateNode);
    recordings.clear();
    (message.recording ?? []).forEach(updateSession);
    arrange();
    takes.markers.send(); // the server is connected again
    look(); // the login may have ended
  },
  node({ node }) {
    const isNew = !cards.has(node.node);
    updateNode(node);
    if (isNew) arrange();
  },
  session: ({ session }) => updateSession(session),
  session_progress: ({ sessions }) => Object.entries(sessions).forEach(([id, progress]) => {
    const session = recordings.get(id);
    if (session) updateSession({ ...session, ...progress });
  }),
  deleted: ({ session_id: id }) => {
    recordings.delete(id);
    for (const card of cards.values()) if (card.session?.id === id) card.session = null;
  },
  heartbeat: ({ nodes }) => cards.forEach((card, name) => { card.heartbeat = nodes?.[name] ?? null; }),
  frame: (frame) => cards.get(frame.node)?.addFrame(frame),
};

const trials = new Trials(() => link.serverNowMs(), () => takes.page.cannotRecord());
const watchers = addDeviceMenu(trials);
const link = new Link({ handlers, watchers, rateHz: RATE_HZ });

function updateNode(node) {
  if (!cards.has(node.node)) cards.set(node.node, new Card(node.node));
  cards.get(node.node).update(node);
}

function updateSession(session) {
  if (session.state === "recording") recordings.set(session.id, session);
  else recordings.delete(session.id);
  const card = cards.get(session.node);
  if (!card) return;
  const shown = card.session;
  // Show the running recording, else the latest session.
  const running = [...recordings.values()].filter((one) => one.node === session.node).sort((a, b) => b.started_t_ns - a.started_t_ns)[0];
  if (running) card.session = running;
  else if (!shown || shown.id === session.id || session.started_t_ns >= shown.started_t_ns) card.session = session;
}

/** Sort the cards by name. */
function arrange() {
  const names = [...cards.keys()].sort((a, b) => a.localeCompare(b, "en", { numeric: true }));
  byId("cards").replaceChildren(...names.map((name) => cards.get(name).element));
}

function write() {
  const nowMs = performance.now();
  const all = [...cards.values()];
  for (const card of all) card.write(nowMs, link.serverNowMs(), link.open);
  const live = link.open ? all.filter((card) => card.isLive(nowMs)).length : 0;
  setText(byId("summary"), all.length ? `${live} of ${all.length} live` : "");
  byId("no-nodes").hidden = Boolean(all.length) || !link.open;
  const down = byId("link-down");
  down.hidden = link.open || !link.failures && !all.length;
  setText(down, link.open ? "" : `Server link down${link.closeReason ? ` (${link.closeReason})` : ""}; reconnecting.`);
  takes.draw();
  trials.draw();
}

function draw() {
  requestAnimationFrame(draw);
  for (const card of cards.values()) card.draw();
}

function recolour() {
  for (const card of cards.values()) card.recolour();
}
document.addEventListener("foottile-colours", recolour);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", recolour);
inSunlight();
helpWithKeys(LOSSES_HELP);
setInterval(write, EVERY_MS);
write();
draw();
