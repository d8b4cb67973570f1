// What became of every frame of a session, and how that is proven, in plain words.

import * as api from "../common/api.js";
import { frames, lossesInWords } from "../common/losses.js";
import { byId, bytes, el } from "../common/text.js";

/** @returns {string[]} sentences */
export function ledgerInWords(ledger, session) {
  const said = [];
  const total = (name) => ledger.parts.reduce((sum, part) => sum + part[name], 0);
  said.push(`${frames(total("recorded"))} ${total("recorded") === 1 ? "is" : "are"} in it.`);
  const pending = total("pending");
  if (pending) said.push(`${frames(pending)} more are still with the node.`);
  for (const loss of lossesInWords(session.lost)) said.push(`Lost for good: ${loss}.`);
  if (session.tail_frames_max) said.push(`At most ${frames(session.tail_frames_max)} more may have been taken at an end that the node could not tell.`);
  if (ledger.missed_slots) said.push(`${ledger.missed_slots.toLocaleString("en-GB")} times the node was late and took no frame: these were never there, and have no number.`);
  if (ledger.parts.length > 1) said.push(`The node was started again: the session has ${ledger.parts.length} parts.`);
  if (ledger.complete) said.push("Every number from the first frame to the last is accounted for, and none is lost.");
  if (session.sha256) {
    said.push(`Its file, ${bytes(session.bytes)}, is sealed: SHA-256 ${session.sha256}. What is shown here was held against checksums as it was read; “foottile pull” and “foottile verify” prove the whole file on your own computer.`);
  } else said.push("It is not sealed yet: nothing of this is final.");
  return said;
}

export class LedgerCard {
  constructor() {
    this.card = byId("ledger-card", HTMLDetailsElement);
    this.session = null;
    this.card.addEventListener("toggle", () => this.load());
  }

  /** @param {Session} session */
  show(session) {
    const grown = this.session?.frames !== session.frames || this.session?.state !== session.state;
    this.session = session;
    this.card.hidden = false;
    if (grown) this.load();
  }

  async load() {
    if (!this.card.open) return;
    const ledger = await api.ledgerOf(this.session.id).catch((error) => error);
    const lines = ledger instanceof Error ? [ledger.message] : ledgerInWords(ledger, this.session);
    byId("ledger").replaceChildren(...lines.map((text) => el("li", { text })));
  }
}
