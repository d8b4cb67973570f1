// The page of one session: asks for it, and plots what there is; for as long as it is not sealed, again and again.

import * as api from "../common/api.js";
import { edit } from "../common/dialogs.js";
import { helpWithKeys } from "../common/help.js";
import { enter } from "../common/login.js";
import { notice, quietly } from "../common/notices.js";
import { unlessRefused } from "../common/request.js";
import { inSunlight } from "../common/sunlight.js";
import { byId, printable, setText } from "../common/text.js";
import { plainState } from "../sessions/state.js";
import { drawHeader } from "./header.js";
import { LedgerCard } from "./ledger.js";
import { Plotted } from "./plotted.js";

const AGAIN_MS = 1000;

const id = decodeURIComponent(location.pathname.split("/").pop());
let plotted = null;
let now = null; // the session as it was last heard of
const ledger = new LedgerCard();

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
  document.title = printable(`${session.name} – FootTile`);
  now = session;
  drawNow();
  byId("edit").hidden = false;
  ledger.show(session);
  plotted ??= new Plotted(session, drawNow);
  if (session.state !== "sealed") {
    say(session.state === "recording" ? "Being recorded" : "Not sealed yet", [WHY[session.state] ?? session.problem ?? "", plainState(session)[1]].join(" ").trim());
    byId("message").dataset.small = "true";
    // Before its first frames there is nothing to plot.
    await unlessRefused(plotted.load(session));
    if (plotted.plots.whole?.behind) setText(byId("message-text"), `${byId("message-text").textContent} Not all of it is shown yet: the server is estimating the rest.`);
    document.body.dataset.state = session.state;
    setTimeout(look, AGAIN_MS);
    return;
  }
  byId("message").hidden = true;
  try {
    await plotted.load(session);
    document.body.dataset.state = "sealed";
  } catch (error) {
    if (!(error instanceof api.Refusal)) throw error;
    document.body.dataset.state = "refused";
    const damaged = error.status === 500;
    if (damaged) ledger.doubt();
    say("Its numbers cannot be shown", damaged ? `Something is wrong with its files; “Check its files now”, above, says what. The server's words: ${error.message}` : error.message);
    if (error.status === 0) setTimeout(look, 3 * AGAIN_MS);
  }
}

/** What people say of it. Who was overtaken by somebody else is told, and shown what they wrote. */
async function change() {
  const before = now;
  const changes = await edit(before);
  if (!changes) return;
  try {
    now = await api.changeSession(id, changes, before.said);
  } catch (error) {
    if (!(error instanceof api.Refusal) || error.status !== 412) throw error;
    notice(error.message, { bad: true });
    now = await api.getSession(id);
  }
  document.title = printable(`${now.name} – FootTile`);
  drawNow();
}

/** What it is, as far as that is known by now. */
function drawNow() {
  drawHeader(now, plotted?.plots.whole ?? null, plotted?.replay.array?.nominal_rate_hz ?? null);
}

byId("edit").addEventListener("click", () => quietly(change));

function say(title, text) {
  byId("message").hidden = false;
  delete byId("message").dataset.small;
  setText(byId("message-title"), title);
  setText(byId("message-text"), text);
}

const WHY = {
  recording: "This session is still being recorded: what is shown is provisional until it is sealed.",
  pending: "This session has been stopped, and something of it is still with its node. What is shown is provisional.",
  sealing: "This session is being written. What is shown is provisional for a moment yet.",
};

inSunlight();
helpWithKeys();
enter().then(() => quietly(look));
