// Page of the guided calibration: form, instructions, result. The server holds the state; this page polls it.

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

const FRAMES_HZ = 1; // this page shows no frames
const POLL_RUNNING_MS = 300;
const POLL_IDLE_MS = 2000;

/** @type {Map<string, NodeView>} */
const nodes = new Map();
/** @type {WeighingView | null} */
let weighing = null;
let name = new URLSearchParams(location.search).get("node");
let requests = 0; // responses to older requests are ignored
/** @type {ReturnType<typeof setTimeout> | undefined} */
let timer;

const setup = new Setup((body) => run(() => api.startWeighing(selected(), body)));
const guide = new Guide({
  onRepeat: () => run(() => api.repeatWeight(selected(), weighing?.session_id ?? "")),
  onCancel: () => run(() => api.endWeighing(selected(), weighing?.session_id ?? "")),
});
const result = new Result({
  onAccept: (id) => run(async () => {
    const { calibration } = await api.calibrationOf(selected());
    await api.assignCalibration(selected(), id, calibration?.id ?? "none");
    await api.endWeighing(selected(), weighing?.session_id ?? "");
    notice(`${selected()} uses this calibration from the next frame.`);
  }),
  onSave: () => run(async () => {
    const { name: saved } = weighing?.result ?? { name: "" };
    await api.endWeighing(selected(), weighing?.session_id ?? "");
    if (saved) notice(`Saved as “${saved}”.`);
  }),
  onRestart: () => run(async () => {
    if (!weighing) return;
    const { session_id: session, result: oldResult, tiles, weights, method, reference, name: oldName } = weighing;
    const body = { tiles: tiles.map((tile) => tile.serial), weights, method, reference, name: oldName };
    const next = await api.startWeighing(selected(), body);
    if (oldResult) await unlessRefused(api.deleteCalibration(oldResult.calibration_id));
    if (next.session_id !== session) result.reset();
  }),
});

const link = new Link({
  rateHz: FRAMES_HZ,
  handlers: {
    hello(message) {
      nodes.clear();
      (message.nodes ?? []).forEach((node) => nodes.set(node.node, node));
      selectNode();
      look(); // the login may have ended
    },
    node({ node }) {
      nodes.set(node.node, node);
      selectNode();
    },
  },
  onChange: () => setText(byId("link-down"), link.open || !link.failures ? "" : "Server link down; reconnecting."),
});

/** Return the name of the selected node. */
const selected = () => name ?? "";

/** Keep the selected node, else select a connected one. */
function selectNode() {
  const all = [...nodes.values()];
  const node = nodes.get(selected()) ?? all.find((one) => one.connected) ?? all[0];
  const isOther = node?.node !== name;
  name = node?.node ?? null;
  const names = all.map((one) => one.node).sort();
  const select = byId("node-select", HTMLSelectElement);
  if (names.join("\n") !== [...select.options].map((option) => option.value).join("\n")) {
    select.replaceChildren(...names.map((one) => el("option", { value: one, text: one })));
  }
  select.value = selected();
  byId("node-choice").hidden = names.length < 2;
  byId("node-name").hidden = names.length > 1;
  setText(byId("node-name"), selected());
  if (node) setup.update(node);
  if (isOther || !weighing) poll();
}

/** Run an action, then update the page. @param {() => Promise<unknown>} action */
async function run(action) {
  document.body.setAttribute("aria-busy", "true");
  await quietly(action);
  document.body.removeAttribute("aria-busy");
  await poll();
}

/** Poll the state of the calibration. */
async function poll() {
  clearTimeout(timer);
  const request = ++requests;
  if (name !== null && !document.hidden) {
    const response = await unlessRefused(api.weighingOf(name));
    if (request !== requests) return;
    if (response) show(response.weighing);
  } else show(null);
  const isRunning = weighing !== null && ["weighing", "fitting"].includes(weighing.state);
  timer = setTimeout(poll, isRunning ? POLL_RUNNING_MS : POLL_IDLE_MS);
}

/** Show a state: form, instructions or result. @param {WeighingView | null} next */
function show(next) {
  if (document.hidden) return;
  weighing = next;
  const node = nodes.get(selected());
  const isRunning = next !== null && ["weighing", "fitting"].includes(next.state);
  byId("no-node").hidden = Boolean(node) || !link.open;
  byId("setup").hidden = !node || next !== null;
  if (node && next) setup.fill(next);
  guide.draw(isRunning ? next : null, node?.connected ?? true);
  result.draw(next !== null && !isRunning ? next : null, selected());
}

byId("node-select").addEventListener("change", () => {
  name = byId("node-select", HTMLSelectElement).value;
  history.replaceState(null, "", `?node=${encodeURIComponent(name)}`);
  show(null);
  selectNode();
  poll();
});
document.addEventListener("visibilitychange", () => document.hidden || poll());
inSunlight();
helpWithKeys();
