// Page of sessions: list and trash, updated over the websocket.

import { helpWithKeys } from "../common/help.js";
import { Link } from "../common/link.js";
import { LOSSES_HELP } from "../common/losses.js";
import { look } from "../common/login.js";
import { inSunlight } from "../common/sunlight.js";
import { byId, setText } from "../common/text.js";
import { Sessions } from "./list.js";
import { Trash } from "./trash.js";

const RATE_HZ = 1; // no frames on this page

function updateSession(session) {
  sessions.update(session);
  trash.follow(session);
}

function removeSession(id) {
  sessions.drop(id);
  trash.load();
}

const trash = new Trash(updateSession, (count) => sessions.setTrashCount(count));
const sessions = new Sessions({ onSession: updateSession, onDeleted: removeSession });

/** @type {import("../common/link.js").Handlers} */
const handlers = {
  hello() {
    sessions.load();
    trash.load();
    look(); // the login may have ended with the server
  },
  session: ({ session }) => updateSession(session),
  session_progress: ({ sessions: counts }) => Object.entries(counts).forEach(([id, progress]) => sessions.updateProgress(id, progress)),
  deleted: ({ session_id: id }) => removeSession(id),
};

const link = new Link({
  handlers,
  rateHz: RATE_HZ,
  onChange: () => setText(byId("link-down"), link.open || !link.failures ? "" : "Server link down; reconnecting."),
});

inSunlight();
helpWithKeys(LOSSES_HELP);
