// What became of every frame of a session, and how that is proven, in plain words.

import * as api from "../common/api.js";
import { frames, lossesInWords } from "../common/losses.js";
import { byId, bytes, el, localTime, setText } from "../common/text.js";

/** @returns {string[]} sentences */
export function ledgerInWords(ledger, session) {
  const said = [];
  const total = (name) => ledger.parts.reduce((sum, part) => sum + part[name], 0);
  said.push(`${frames(total("recorded"))} ${total("recorded") === 1 ? "is" : "are"} in it.`);
  const pending = total("pending");
  if (pending) said.push(`${frames(pending)} more are still with the node.`);
  for (const loss of lossesInWords(session.lost)) said.push(`Lost for good: ${loss}.`);
  if (session.tail_frames_max) said.push(`At most ${frames(session.tail_frames_max)} more may have been taken at an end that the node could not tell.`);
  if (ledger.missed_slots) said.push(`${ledger.missed_slots.toLocaleString("en-GB")} slot${ledger.missed_slots === 1 ? " was" : "s were"} not sampled: the node was late. They never were frames, have no number, and are not lost.`);
  if (ledger.parts.length > 1) said.push(`The node was started again: the session has ${ledger.parts.length} parts.`);
  if (ledger.complete) said.push("Every number from the first frame to the last is accounted for, and none is lost.");
  if (session.sha256) {
    said.push(`Its file, ${bytes(session.bytes)}, is sealed: SHA-256 ${session.sha256}. What is shown here was held against checksums as it was read. “Check its files now” has the server read all of them again; “foottile pull” and “foottile verify” do the same on your own computer.`);
  } else said.push("It is not sealed yet: nothing of this is final.");
  return said;
}

/**
 * What a check of the files has found: in a sentence, and in detail.
 * @param {Verified} found @param {Session} session @param {Date} at
 * @returns {{whole: boolean, says: string, details: string[]}}
 */
export function verifiedInWords(found, session, at) {
  const whole = !found.problems.length && found.sha256 === session.sha256;
  const read = frames(found.parts.reduce((sum, part) => sum + part.recorded, 0));
  const when = localTime(at).slice(-8);
  if (!whole) {
    const other = found.problems.length ? [] : ["the file of frames is another one than this page is about: load the page again"];
    return { whole, says: `Checked at ${when}: something is wrong with its files. Keep them as they are; a copy may be whole.`, details: [...found.problems, ...other, ...found.unproven] };
  }
  const proven = session.sha256 ? `all ${read} were read again. Frames, ledger, marks, clock, stances and hashes agree with one another` : "not one frame was recorded, and its files agree with one another";
  const rest = found.unproven.length ? ". What they cannot show:" : ": it is what was sealed.";
  return { whole, says: `Checked at ${when}: ${proven}${rest}`, details: found.unproven };
}

export class LedgerCard {
  constructor() {
    this.card = byId("ledger-card", HTMLDetailsElement);
    this.session = null;
    this.card.addEventListener("toggle", () => this.load());
    byId("verify").addEventListener("click", () => this.verify());
  }

  /** @param {Session} session */
  show(session) {
    const grown = this.session?.frames !== session.frames || this.session?.state !== session.state;
    this.session = session;
    this.card.hidden = false;
    byId("verify-box").hidden = session.state !== "sealed";
    if (grown) this.load();
  }

  /** Its files could not be read: what was sealed as complete may be so no more. */
  doubt() {
    const state = byId("state");
    state.className = "state bad";
    setText(state, "its files are damaged");
    this.card.open = true;
  }

  async load() {
    if (!this.card.open) return;
    let lines;
    try {
      lines = ledgerInWords(await api.ledgerOf(this.session.id), this.session);
    } catch (error) {
      if (!(error instanceof api.Refusal)) throw error;
      lines = [error.message];
    }
    byId("ledger").replaceChildren(...lines.map((text) => el("li", { text })));
  }

  /** The server reads all of its files again. */
  async verify() {
    const [button, box] = [byId("verify", HTMLButtonElement), byId("verified")];
    if (button.hasAttribute("aria-busy")) return;
    button.setAttribute("aria-busy", "true");
    box.replaceChildren(el("p", { text: `Reading ${frames(this.session.frames)} …` }));
    try {
      const { whole, says, details } = verifiedInWords(await api.verified(this.session.id), this.session, new Date());
      box.replaceChildren(el("p", { text: says, "data-whole": String(whole) }), el("ul", {}, ...details.map((text) => el("li", { text }))));
    } catch (error) {
      if (!(error instanceof api.Refusal)) throw error;
      box.replaceChildren(el("p", { text: `Not checked: ${error.message}` }));
    } finally {
      button.removeAttribute("aria-busy");
    }
  }
}
