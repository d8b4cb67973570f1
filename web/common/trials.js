// Panel of the list of trials: the next one and its buttons in the action bar, all rows in a dialog.

import * as api from "./api.js";
import { isOperator } from "./login.js";
import { notice, quietly } from "./notices.js";
import { byId, el, isInside, roughly, setData, setText } from "./text.js";

const KEYS = { n: "trial-record", k: "trial-skip", b: "trial-repeat" };
const SIGNS = { open: "", skipped: "skipped", recording: "● recording", pending: "… pending", complete: "✓ complete", lossy: "⚠ lossy" };

/** List of trials of the server. */
export class Trials {
  /** @param {() => number} serverNowMs @param {() => string} cannotRecord reason, or "" */
  constructor(serverNowMs, cannotRecord) {
    this.serverNowMs = serverNowMs;
    this.cannotRecord = cannotRecord;
    /** @type {TrialsView | null} */
    this.list = null;
    this.problem = null;
    this.isBusy = false;
    this.place = el("span", { id: "trial-place" });
    this.name = el("strong", { id: "trial-name" });
    this.tags = el("span", { id: "trial-tags" });
    this.actions = { "trial-record": () => this.record(), "trial-skip": () => this.skip(), "trial-repeat": () => this.repeat() };
    const [record, skip, repeat] = this.buttons = [["trial-record", "Record next"], ["trial-skip", "Skip"], ["trial-repeat", "Repeat last"]].map(([id, text], i) => {
      const button = el("button", { type: "button", id, cls: i ? "" : "primary" }, el("span", { text }), el("kbd", { text: Object.keys(KEYS)[i] }));
      button.addEventListener("click", () => this.run(id));
      return button;
    });
    this.element = el("div", { id: "trials", role: "group", "aria-label": "List of trials", hidden: "" },
      el("p", { id: "trial-next", role: "status" }, this.place, this.name, this.tags), record, skip, repeat);
    byId("actions").prepend(this.element);
    document.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey || event.repeat || !KEYS[event.key]) return;
      if (isInside(event, "input, textarea, select, dialog[open]") || this.element.hidden) return;
      event.preventDefault();
      this.run(KEYS[event.key]);
    });
  }

  /** Show the list of a message. @param {PageMessage} message */
  watch(message) {
    if (message.type !== "hello" && message.type !== "trials") return;
    const isNews = message.type === "trials" && message.trials.problem !== this.list?.problem;
    this.show(message.trials, isNews);
  }

  /** @param {TrialsView} list */
  show(list, isNews = false) {
    this.list = list;
    if (isNews && list.problem) notice(`${list.problem}.`, { stays: true });
    this.draw();
    const dialog = document.getElementById("trials-dialog");
    if (dialog) this.drawRows(dialog);
  }

  async run(id) {
    if (!isOperator()) notice("viewers cannot record trials. To log in as operator, press “viewer” beside the title.", { bad: true });
    else if (!this.isBusy && !byId(id, HTMLButtonElement).disabled) {
      this.isBusy = true;
      await quietly(this.actions[id]).finally(() => { this.isBusy = false; });
    }
  }

  async record() {
    if (this.list.is_armed) return this.show(await api.changeTrials({ is_armed: false }));
    const name = this.list.next_name;
    this.show(await api.recordTrial());
    notice(this.list.is_armed ? `“${name}” begins at the next contact.` : `Recording “${name}”.`);
  }

  async skip() {
    this.show(await api.changeTrials({ next_index: this.list.next_index + 1 }));
  }

  async repeat() {
    this.show(await api.changeTrials({ next_index: this.list.last_index }));
  }

  draw() {
    const { list } = this;
    this.element.hidden = !list?.trials.length;
    if (this.element.hidden) return;
    const count = list.trials.length;
    const isRunning = list.take !== null;
    const now = isRunning ? list.trials[list.last_index] : list.trials[list.next_index];
    const leftS = list.stop_at_t_ns === null ? null : Math.max(0, (list.stop_at_t_ns / 1e6 - this.serverNowMs()) / 1000);
    setText(this.place, isRunning ? `Recording${leftS === null ? "" : `, ${roughly(leftS)} left`}`
      : list.is_armed ? "Waits for contact" : now ? `Next, ${list.next_index + 1} of ${count}` : "List of trials");
    setText(this.name, isRunning && now ? nameOf(now) : list.next_name ?? `all ${count} done or skipped`);
    setText(this.tags, now?.tags.join(", ") ?? "");
    setData(this.element, "state", isRunning ? "recording" : list.is_armed ? "armed" : now ? "next" : "done");
    const [record, skip, repeat] = this.buttons;
    setText(record.firstElementChild, list.is_armed ? "Do not wait" : list.start_at_contact ? "Record at contact" : "Record next");
    record.disabled = !list.is_armed && (isRunning || list.next_name === null || Boolean(this.cannotRecord()));
    skip.disabled = list.next_name === null;
    repeat.disabled = list.last_index === null || list.last_index === list.next_index;
  }

  /** Make the item of a menu that opens the list. */
  makeItem() {
    const item = el("button", { type: "button", text: "Trial list …" });
    item.addEventListener("click", () => this.open());
    return item;
  }

  /** Show all rows, the text of the list, and its settings. */
  open() {
    const text = el("textarea", { id: "trials-text", rows: 5, cls: "requires-operator", "aria-label": "List as text: a trial a line, name; tag, tag", placeholder: "mud 1; wet, deep\nmud 2, mud 3, plate 1" });
    text.value = this.list?.text ?? "";
    const file = el("input", { type: "file", accept: ".txt,.csv,text/plain", "aria-label": "List from a file" });
    file.addEventListener("change", async () => { text.value = await file.files[0].text(); });
    const contact = el("input", { type: "checkbox", id: "trials-contact" });
    contact.checked = Boolean(this.list?.start_at_contact);
    const stop = el("input", { type: "number", id: "trials-stop", min: 1, max: 3600, step: "any", placeholder: "never" });
    stop.value = String(this.list?.stop_after_s ?? "");
    const node = el("select", { id: "trials-node" }, el("option", { value: "", text: "all connected nodes" }));
    const known = new Set([...document.querySelectorAll("#node-select option, .node h2 a")].map((one) => one.textContent).concat(this.list?.node ?? []));
    node.append(...[...known].map((name) => el("option", { value: name, text: name })));
    node.value = this.list?.node ?? "";
    const change = () => this.tell(async () => api.changeTrials(
      { start_at_contact: contact.checked, stop_after_s: stop.value === "" ? null : Number(stop.value), node: node.value || null }));
    for (const one of [contact, stop, node]) one.addEventListener("change", change);
    const use = el("button", { type: "button", id: "trials-use", text: "Use this list" });
    use.addEventListener("click", () => this.tell(() => api.setTrials(text.value)));
    const dialog = el("dialog", { id: "trials-dialog", "aria-labelledby": "trials-title" }, el("form", { method: "dialog" },
      el("h2", { id: "trials-title", text: "Trial list" }), el("ol", { id: "trials-rows" }),
      el("p", { id: "trials-said", role: "alert" }), text,
      el("p", { cls: "row requires-operator" }, use, file),
      el("fieldset", { cls: "requires-operator" }, el("label", {}, contact, " Start at contact, with 1 s before it"),
        el("label", {}, "Stop after ", stop, " s"), el("label", {}, "Record ", node)),
      el("p", { cls: "row" }, el("button", { type: "submit", value: "", text: "Close", autofocus: "" }))));
    document.body.append(dialog);
    dialog.addEventListener("close", () => dialog.remove());
    dialog.showModal();
    this.drawRows(dialog);
  }

  /** Run a change of the dialog; a refusal is shown in it, since it covers the notices. */
  async tell(change) {
    const said = byId("trials-said");
    setText(said, "");
    try {
      this.show(await change());
    } catch (error) {
      if (!(error instanceof api.Refusal)) throw error;
      setText(said, error.message);
    }
  }

  drawRows(dialog) {
    const rows = dialog.querySelector("#trials-rows");
    rows.replaceChildren(...(this.list?.trials ?? []).map((row, i) => {
      const isNext = i === this.list.next_index;
      const name = row.sessions.length ? el("a", { href: `/sessions/${encodeURIComponent(row.sessions[0])}`, text: nameOf(row) }) : el("span", { text: row.name });
      return el("li", { "data-state": row.state, ...(isNext ? { "aria-current": "step" } : {}) }, name,
        el("span", { cls: "trial-row-tags", text: row.tags.join(", ") }), el("span", { cls: "trial-row-state", text: isNext ? "next" : SIGNS[row.state] }));
    }));
    rows.querySelector("[aria-current]")?.scrollIntoView({ block: "center" });
  }
}

/** Return the name of the latest recording of a row. @param {TrialView} row */
const nameOf = (row) => (row.recordings > 1 ? `${row.name} (${row.recordings})` : row.name);
