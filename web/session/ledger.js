// Integrity of a session: ledger and verification as texts.

import * as api from "../common/api.js";
import { frames, lossTexts, percentText } from "../common/losses.js";
import { unlessRefused } from "../common/request.js";
import { byId, bytes, el, localTime, setText } from "../common/text.js";

/** Return the ledger as sentences. @returns {string[]} */
export function ledgerTexts(ledger, session) {
  const texts = [];
  const total = (name) => ledger.parts.reduce((sum, part) => sum + part[name], 0);
  texts.push(`${frames(total("recorded"))} recorded.`);
  const pending = total("pending");
  if (pending) texts.push(`${frames(pending)} still on the node.`);
  for (const [, text] of lossTexts(session.lost)) texts.push(`Lost: ${text}.`);
  if (session.max_lost_tail_frames) texts.push(`Up to ${frames(session.max_lost_tail_frames)} at the end may be lost (power failure).`);
  if (ledger.missed_slots) texts.push(`${ledger.missed_slots.toLocaleString("en-GB")} slot${ledger.missed_slots === 1 ? "" : "s"} not sampled (node late), ${percentText(session.not_sampled_share)} of all. They have no frame number and do not count as lost.`);
  if (ledger.parts.length > 1) texts.push(`Node restarted: ${ledger.parts.length} parts.`);
  if (ledger.complete) texts.push("Complete: every frame that was sampled is stored.");
  if (session.sha256) {
    texts.push(`Sealed file: ${bytes(session.bytes)}, SHA-256 ${session.sha256}. Data on this page were verified by checksum. “Verify files” reads all files again on the server; “foottile pull” and “foottile verify” do so on your computer.`);
  } else texts.push("Not sealed yet: these figures are provisional.");
  return texts;
}

/**
 * Return the result of a verification: summary and details.
 * @param {VerificationView} found @param {SessionView} session @param {Date} at
 * @returns {{whole: boolean, summary: string, details: string[]}}
 */
export function verificationTexts(found, session, at) {
  const whole = !found.problems.length && found.sha256 === session.sha256;
  const read = frames(found.parts.reduce((sum, part) => sum + part.recorded, 0));
  const when = localTime(at).slice(-8);
  if (!whole) {
    const other = found.problems.length ? [] : ["the file of frames has changed since this page was loaded: reload"];
    return { whole, summary: `Checked at ${when}: files are damaged. Keep them; a copy may be intact.`, details: [...found.problems, ...other] };
  }
  const proven = session.sha256 ? `all ${read} read again; frames, ledger, markers, clock, stances and hashes are consistent` : "no frames; files are consistent";
  return { whole, summary: `Verified at ${when}: ${proven}.`, details: [] };
}

/** Card of ledger and verification. */
export class LedgerCard {
  constructor() {
    this.card = byId("ledger-card", HTMLDetailsElement);
    this.session = null;
    this.card.addEventListener("toggle", () => this.load());
    byId("verify").addEventListener("click", () => this.verify());
  }

  /** @param {SessionView} session */
  show(session) {
    const grown = this.session?.frames !== session.frames || this.session?.state !== session.state;
    this.session = session;
    this.card.hidden = false;
    byId("verify-box").hidden = session.state !== "sealed";
    if (grown) this.load();
  }

  /** Show that files could not be read. */
  showDamage() {
    const state = byId("state");
    state.className = "state bad";
    setText(state, "files damaged");
    this.card.open = true;
  }

  async load() {
    if (!this.card.open) return;
    const lines = await unlessRefused(api.ledgerOf(this.session.id).then((found) => ledgerTexts(found, this.session)), ({ message }) => [message]);
    byId("ledger").replaceChildren(...lines.map((text) => el("li", { text })));
  }

  /** Let the server read all files again. */
  async verify() {
    const [button, box] = [byId("verify", HTMLButtonElement), byId("verified")];
    if (button.hasAttribute("aria-busy")) return;
    button.setAttribute("aria-busy", "true");
    box.replaceChildren(el("p", { text: `Reading ${frames(this.session.frames)} …` }));
    try {
      const { whole, summary, details } = verificationTexts(await api.verifyFiles(this.session.id), this.session, new Date());
      box.replaceChildren(el("p", { text: summary, "data-whole": String(whole) }), el("ul", {}, ...details.map((text) => el("li", { text }))));
    } catch (error) {
      if (!(error instanceof api.Refusal)) throw error;
      box.replaceChildren(el("p", { text: `Not verified: ${error.message}` }));
    } finally {
      button.removeAttribute("aria-busy");
    }
  }
}
