// Header of a session: name, state, facts, labels and notes.

import { byId, duration, el, localTime, perSecond, setText, TARE_SOURCES } from "../common/text.js";
import { stateText, stateTitle } from "../sessions/state.js";

/**
 * Return the achieved rate, such as "434 of 449 frames/s".
 * @param {import("./bins.js").Bins | null} whole @param {number | null} nominalHz
 */
export function rateText(whole, nominalHz) {
  const hz = whole?.rateHz ?? null;
  if (hz === null || nominalHz === null) return "";
  return `${perSecond(hz)} of ${perSecond(nominalHz)} frames/s`;
}

/** Return times and kinds of a session's tares, "" without one. @param {ArrayView["tares"]} tares */
export function taresText(tares) {
  const texts = tares.map(({ t_ns: t, source }) => (source === "lost" ? "one is lost" : `${localTime(new Date(t / 1e6))} ${TARE_SOURCES[source] ?? ""}`.trim()));
  return texts.length > 3 ? `${texts[0]}, and ${texts.length - 1} more` : texts.join("; ");
}

/**
 * Draw the header.
 * @param {SessionView} session
 * @param {import("./bins.js").Bins | null} whole bins of the whole session, once loaded
 * @param {ArrayView | null} array
 */
export function drawHeader(session, whole = null, array = null) {
  setText(byId("name"), session.name || session.id);
  const [short, long, weight] = stateText(session);
  const state = byId("state");
  state.className = `state ${weight}`;
  setText(state, short);
  state.title = stateTitle(session);
  setText(byId("state-why"), session.state === "sealed" ? long : "");
  const facts = [
    ["Node", session.node],
    ["Started", localTime(new Date(session.started_t_ns / 1e6))],
    ["Duration", duration(session.duration_s)],
    ["Frames", session.frames.toLocaleString("en-GB")],
    ["Rate", rateText(whole, array?.nominal_rate_hz ?? null)],
    ["Parts", session.parts.length > 1 ? String(session.parts.length) : ""],
    ["Scene", session.scene],
    ["Tared", taresText(array?.tares ?? [])],
    ["Scale", session.absolute_scale === "assumed" ? "assumed: newtons are approximate" : ""],
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
