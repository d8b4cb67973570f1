// Page of a session: loads and plots it, repeatedly until it is sealed.

import * as api from "../common/api.js";
import { edit } from "../common/dialogs.js";
import { helpWithKeys } from "../common/help.js";
import { LOSSES_HELP } from "../common/losses.js";
import { logInFromUrl } from "../common/login.js";
import { notice, quietly } from "../common/notices.js";
import { unlessRefused } from "../common/request.js";
import { inSunlight } from "../common/sunlight.js";
import { byId, printable, setText } from "../common/text.js";
import { stateText } from "../sessions/state.js";
import { drawHeader } from "./header.js";
import { LedgerCard } from "./ledger.js";
import { Plotted } from "./plotted.js";

const REFRESH_MS = 1000;

const id = decodeURIComponent(location.pathname.split("/").pop());
let plotted = null;
let current = null; // latest version of the session
const ledger = new LedgerCard();

/** Load the session; again until it is sealed. */
async function refresh() {
  let session;
  try {
    session = await api.getSession(id);
  } catch (error) {
    if (!(error instanceof api.Refusal)) throw error;
    document.body.dataset.state = "refused";
    if (error.status === 404) showMessage("Session not found", `No session “${id}” on this server. It may be in the trash.`);
    else showMessage("Session unavailable", error.message);
    if (error.status === 0 || error.status >= 500) setTimeout(refresh, 3 * REFRESH_MS); // retry
    return;
  }
  document.title = printable(`${session.name} – FootTile`);
  current = session;
  drawSessionHeader();
  byId("edit").hidden = false;
  ledger.show(session);
  plotted ??= new Plotted(session, drawSessionHeader);
  if (session.state !== "sealed") {
    showMessage(session.state === "recording" ? "Recording" : "Not sealed", [STATE_TEXTS[session.state] ?? session.problem ?? "", stateText(session)[1]].join(" ").trim());
    byId("message").dataset.small = "true";
    // Without frames there is nothing to plot.
    await unlessRefused(plotted.load(session));
    if (plotted.plots.whole?.catching_up) setText(byId("message-text"), `${byId("message-text").textContent} Estimation is catching up; the rest follows.`);
    document.body.dataset.state = session.state;
    setTimeout(refresh, REFRESH_MS);
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
    if (damaged) ledger.showDamage();
    showMessage("Data unavailable", damaged ? `Files are damaged: ${error.message} For details press “Verify files” above.` : error.message);
    if (error.status === 0) setTimeout(refresh, 3 * REFRESH_MS);
  }
}

/** Edit labels and notes. After a conflict show the reason and the other version. */
async function editSession() {
  const before = current;
  const changes = await edit(before);
  if (!changes) return;
  try {
    current = await api.changeSession(id, changes, before.revision);
  } catch (error) {
    if (!(error instanceof api.Refusal) || error.status !== 412) throw error;
    notice(error.message, { bad: true });
    current = await api.getSession(id);
  }
  document.title = printable(`${current.name} – FootTile`);
  drawSessionHeader();
}

/** Draw the header with what is loaded. */
function drawSessionHeader() {
  drawHeader(current, plotted?.plots.whole ?? null, plotted?.replay.array ?? null);
}

byId("edit").addEventListener("click", () => quietly(editSession));

function showMessage(title, text) {
  byId("message").hidden = false;
  delete byId("message").dataset.small;
  setText(byId("message-title"), title);
  setText(byId("message-text"), text);
}

const STATE_TEXTS = {
  recording: "Values are provisional until the session is sealed.",
  pending: "Stopped; frames are still on the node. Values are provisional.",
  sealing: "Writing files. Values are provisional.",
};

inSunlight();
helpWithKeys(LOSSES_HELP);
logInFromUrl().then(() => quietly(refresh));
