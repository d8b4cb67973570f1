// What a session is: name, node, when, how long, whether it is complete, and what people said of it.

import { byId, duration, el, localTime, setText } from "../common/text.js";
import { plainState } from "../sessions/state.js";

const WORDS = {
  complete: "complete: no frame was lost",
  lossy: "frames are missing",
  incomplete: "not complete",
};

/** @param {Session} session */
export function drawHeader(session) {
  setText(byId("name"), session.name || session.id);
  const [short, long, weight] = plainState(session);
  const state = byId("state");
  state.className = `state ${weight}`;
  setText(state, WORDS[short] ?? short);
  setText(byId("state-why"), session.state === "sealed" ? long : "");
  const facts = [
    ["Node", session.node],
    ["Started", localTime(new Date(session.started_t_ns / 1e6))],
    ["Duration", duration(session.duration_s)],
    ["Frames", session.frames.toLocaleString("en-GB")],
    ["Parts", session.parts.length > 1 ? String(session.parts.length) : ""],
    ["Scene", session.scene],
    ["Scale", session.absolute_scale === "assumed" ? "assumed: newtons are not to be trusted" : ""],
    ["Subject", session.subject],
    ["Tags", session.tags.map((tag) => `#${tag}`).join(" ")],
    ["Notes", session.notes],
  ].filter(([, value]) => value);
  const key = JSON.stringify(facts);
  const list = byId("about");
  if (list.dataset.key !== key) {
    list.dataset.key = key;
    list.replaceChildren(...facts.map(([name, value]) => el("div", {}, el("dt", { text: name }), el("dd", { text: value }))));
  }
}
