// The page of one session: asks for it, and for as long as it is not sealed says so; then plots.

import * as api from "../common/api.js";
import { enter } from "../common/login.js";
import { quietly } from "../common/notices.js";
import { byId, el, localTime, duration, setText } from "../common/text.js";
import { plainState } from "../sessions/state.js";
import { drawHeader } from "./header.js";
import { Plotted } from "./plotted.js";

const AGAIN_MS = 1000;

const id = decodeURIComponent(location.pathname.split("/").pop());
let plotted = null;

async function look() {
  let session;
  try {
    session = await api.getSession(id);
  } catch (error) {
    if (!(error instanceof api.Refusal)) throw error;
    document.body.dataset.state = "refused";
    if (error.status === 404) say("There is no such session", `Session “${id}” is not on this server. It may be in the trash.`);
    else say("This session cannot be shown", error.message);
    if (error.status === 0 || error.status >= 500) setTimeout(look, 3 * AGAIN_MS); // it may be back soon
    return;
  }
  document.title = `${session.name} – FootTile`;
  drawHeader(session);
  if (session.state !== "sealed") {
    document.body.dataset.state = session.state;
    await waiting(session);
    setTimeout(look, AGAIN_MS);
    return;
  }
  byId("message").hidden = true;
  try {
    plotted ??= new Plotted(session);
    await plotted.load();
    document.body.dataset.state = "sealed";
  } catch (error) {
    if (!(error instanceof api.Refusal)) throw error;
    document.body.dataset.state = "refused";
    say("Its numbers cannot be shown", error.message);
    if (error.status === 0) setTimeout(look, 3 * AGAIN_MS);
  }
}

function say(title, text, ...more) {
  byId("message").hidden = false;
  setText(byId("message-title"), title);
  setText(byId("message-text"), text);
  byId("message-more").replaceChildren(...more);
}

const WHY = {
  recording: "This session is still being recorded. Its plots appear here by themselves when it has been stopped and sealed.",
  pending: "This session has been stopped, and something of it is still with its node. Its plots appear here by themselves when that has come.",
  sealing: "This session is being written. Its plots appear here in a moment.",
};

/** What is known of a session that is not sealed yet: how far it is, and its marks. */
async function waiting(session) {
  const marks = session.marks ? (await api.listEvents(session.id).catch(() => null))?.items ?? [] : [];
  const more = [el("p", { text: `${session.frames.toLocaleString("en-GB")} frames in ${duration(session.duration_s)} so far. ${plainState(session)[1]}`.trim() })];
  if (marks.length) {
    more.push(el("p", { text: "Marks:" }), el("ul", {}, ...marks.map((mark) => el("li", { text: `${localTime(new Date(mark.t_ns / 1e6))} ${mark.label}` }))));
  }
  say(session.state === "recording" ? "Being recorded" : "Not sealed yet", WHY[session.state] ?? session.problem ?? "", ...more);
}

enter().then(() => quietly(look));
