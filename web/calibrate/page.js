// The guided calibration of a node: set up, guided, looked at. The server has the state; this page asks for it.

import * as api from "../common/api.js";
import { helpWithKeys } from "../common/help.js";
import { Link } from "../common/link.js";
import { look } from "../common/login.js";
import { notice, quietly } from "../common/notices.js";
import { unlessRefused } from "../common/request.js";
import { inSunlight } from "../common/sunlight.js";
import { byId, el, setText } from "../common/text.js";
import { Guide } from "./guide.js";
import { Result } from "./result.js";
import { Setup } from "./setup.js";

const FRAMES_HZ = 1; // this page draws no frames
const SOON_MS = 300; // while something is going on
const LATER_MS = 2000;

/** @type {Map<string, LiveNode>} */
const nodes = new Map();
/** @type {Weighing | null} */
let weighing = null;
let name = new URLSearchParams(location.search).get("node");
let asked = 0; // answers to an older question are not shown
/** @type {ReturnType<typeof setTimeout> | undefined} */
let timer;

const setup = new Setup((body) => act(() => api.startWeighing(chosen(), body)));
const guide = new Guide({
  onRepeat: () => act(() => api.repeatWeight(chosen(), weighing?.session_id ?? "")),
  onCancel: () => act(() => api.endWeighing(chosen(), weighing?.session_id ?? "")),
});
const result = new Result({
  onAccept: (id) => act(async () => {
    const { calibration } = await api.calibrationOf(chosen());
    await api.assignCalibration(chosen(), id, calibration?.id ?? "none");
    await api.endWeighing(chosen(), weighing?.session_id ?? "");
    notice(`${chosen()} uses it from now on.`);
  }),
  onSave: () => act(async () => {
    const { name: saved } = weighing?.result ?? { name: "" };
    await api.endWeighing(chosen(), weighing?.session_id ?? "");
    if (saved) notice(`Saved as “${saved}”.`);
  }),
  onAgain: () => act(async () => {
    if (!weighing) return;
    const { session_id: session, result: found, tiles, weights, method, reference, name: called } = weighing;
    const body = { tiles: tiles.map((tile) => tile.serial), weights, method, reference, name: called };
    const next = await api.startWeighing(chosen(), body);
    if (found) await unlessRefused(api.deleteCalibration(found.calibration_id));
    if (next.session_id !== session) result.forget();
  }),
});

const link = new Link({
  rateHz: FRAMES_HZ,
  onMessage(message) {
    if (message.type === "hello") {
      nodes.clear();
      (message.nodes ?? []).forEach((node) => nodes.set(node.node, node));
      choose();
      look(); // the login may have ended with the server
    } else if (message.type === "node") {
      nodes.set(message.node.node, message.node);
      choose();
    }
  },
  onChange: () => setText(byId("link-down"), link.open || !link.failures ? "" : "Link to the server is down; trying again."),
});

/** Name of the node that is shown. */
const chosen = () => name ?? "";

/** Keep the choice; else the first that is connected. */
function choose() {
  const all = [...nodes.values()];
  const node = nodes.get(chosen()) ?? all.find((one) => one.connected) ?? all[0];
  const isOther = node?.node !== name;
  name = node?.node ?? null;
  const names = all.map((one) => one.node).sort();
  const select = byId("node-select", HTMLSelectElement);
  if (names.join("\n") !== [...select.options].map((option) => option.value).join("\n")) {
    select.replaceChildren(...names.map((one) => el("option", { value: one, text: one })));
  }
  select.value = chosen();
  byId("node-choice").hidden = names.length < 2;
  byId("node-name").hidden = names.length > 1;
  setText(byId("node-name"), chosen());
  if (node) setup.take(node);
  if (isOther || !weighing) ask();
}

/** Do what was pressed, and show what came of it. @param {() => Promise<unknown>} what */
async function act(what) {
  document.body.setAttribute("aria-busy", "true");
  await quietly(what);
  document.body.removeAttribute("aria-busy");
  await ask();
}

/** Ask how far it is, now and again. */
async function ask() {
  clearTimeout(timer);
  const mine = ++asked;
  if (name !== null && !document.hidden) {
    const answer = await unlessRefused(api.weighingOf(name));
    if (mine !== asked) return;
    if (answer) show(answer.weighing);
  } else show(null);
  const isUnderWay = weighing !== null && ["weighing", "fitting"].includes(weighing.state);
  timer = setTimeout(ask, isUnderWay ? SOON_MS : LATER_MS);
}

/** @param {Weighing | null} next */
function show(next) {
  if (document.hidden) return;
  weighing = next;
  const node = nodes.get(chosen());
  const isUnderWay = next !== null && ["weighing", "fitting"].includes(next.state);
  byId("no-node").hidden = Boolean(node) || !link.open;
  byId("setup").hidden = !node || next !== null;
  guide.draw(isUnderWay ? next : null, node?.connected ?? true);
  result.draw(next !== null && !isUnderWay ? next : null, chosen());
}

byId("node-select").addEventListener("change", () => {
  name = byId("node-select", HTMLSelectElement).value;
  history.replaceState(null, "", `?node=${encodeURIComponent(name)}`);
  show(null);
  choose();
  ask();
});
document.addEventListener("visibilitychange", () => document.hidden || ask());
inSunlight();
helpWithKeys();
