// The page of recorded sessions: the list and the trash, kept up to date by the link.

import { helpWithKeys } from "../common/help.js";
import { Link } from "../common/link.js";
import { look } from "../common/login.js";
import { inSunlight } from "../common/sunlight.js";
import { byId, setText } from "../common/text.js";
import { Sessions } from "./list.js";
import { Trash } from "./trash.js";

const RATE_HZ = 1; // this page draws no frames

const takeSession = (session) => sessions.take(session);

function forgetSession(id) {
  sessions.drop(id);
  trash.changed();
}

const trash = new Trash(takeSession);
const sessions = new Sessions({ onSession: takeSession, onDeleted: forgetSession });

const handlers = {
  hello() {
    sessions.reload();
    trash.changed();
    look(); // the login may have ended with the server
  },
  session: ({ session }) => takeSession(session),
  counted: ({ sessions: counts }) => Object.entries(counts).forEach(([id, counted]) => sessions.count(id, counted)),
  deleted: ({ session_id: id }) => forgetSession(id),
};

const link = new Link({
  rateHz: RATE_HZ,
  onMessage(message) {
    if (Object.hasOwn(handlers, message.type)) handlers[message.type](message);
  },
  onChange: () => setText(byId("link-down"), link.open || !link.failures ? "" : "Link to the server is down; trying again."),
});

inSunlight();
helpWithKeys();
