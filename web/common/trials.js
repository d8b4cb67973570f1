// Panel of the list of trials in the action bar: the next one, or the running one, and buttons.

import * as api from "./api.js";
import { notice, quietly } from "./notices.js";
import { press } from "./press.js";
import { loadModule } from "./request.js";
import { byId, el, isShortcut, roughly, setData, setText } from "./text.js";

/** List of trials of the server. */
export class Trials {
  /** @param {() => number} serverNowMs @param {() => string} cannotRecord reason, or "" */
  constructor(serverNowMs, cannotRecord) {
    this.serverNowMs = serverNowMs;
    this.cannotRecord = cannotRecord;
    /** @type {TrialsView | null} */
    this.list = null;
    /** @type {(() => void) | null} */
    this.drawDialog = null;
    this.place = el("span", { id: "trial-place" });
    this.name = el("strong", { id: "trial-name" });
    this.tags = el("span", { id: "trial-tags" });
    this.record = this.makeButton("record", "n", "Record next", () => this.recordNext());
    this.skip = this.makeButton("skip", "k", "Skip", () => this.change({ next_index: this.list.next_index + 1 }));
    this.repeat = this.makeButton("repeat", "b", "Repeat last", () => this.change({ next_index: this.list.last_index }));
    this.element = el("div", { id: "trials", role: "group", "aria-label": "List of trials", hidden: "" },
      el("p", { id: "trial-next", role: "status" }, this.place, this.name, this.tags), this.record, this.skip, this.repeat);
    byId("actions").prepend(this.element);
  }

  makeButton(id, key, text, act) {
    const button = el("button", { type: "button", id: `trial-${id}` }, el("span", { text }), el("kbd", { text: key }));
    // One at a time of the three: Skip during Record would skip another row.
    const run = () => this.element.querySelector("[aria-busy]") ?? press(button, "record trials", act);
    button.addEventListener("click", run);
    document.addEventListener("keydown", (event) => {
      if (event.key !== key || event.repeat || !isShortcut(event) || this.element.hidden) return;
      event.preventDefault();
      run();
    });
    return button;
  }

  /** Show the list of a message. @param {PageMessage} message */
  watch(message) {
    if (message.type !== "hello" && message.type !== "trials") return;
    const { problem } = message.trials;
    if (message.type === "trials" && problem && problem !== this.list?.problem) notice(`${problem}.`, { stays: true });
    this.show(message.trials);
  }

  /** @param {TrialsView} list */
  show(list) {
    this.list = list;
    this.draw();
    this.drawDialog?.();
  }

  async change(changes) {
    this.show(await api.changeTrials(changes));
  }

  async recordNext() {
    if (this.list.is_armed) return this.change({ is_armed: false });
    const name = this.list.next_name;
    this.show(await api.recordTrial());
    notice(this.list.is_armed ? `“${name}” begins at the next contact.` : `Recording “${name}”.`);
  }

  draw() {
    const { list } = this;
    const count = list?.trials.length;
    const isRunning = Boolean(list?.take);
    this.element.hidden = !count && !isRunning;
    if (this.element.hidden) return;
    const now = list.trials[isRunning ? list.last_index : list.next_index]; // none: not in the list any longer, or all are done
    const leftS = list.stop_at_t_ns === null ? null : Math.max(0, (list.stop_at_t_ns / 1e6 - this.serverNowMs()) / 1000);
    setText(this.place, isRunning ? `Recording${leftS === null ? "" : `, ${roughly(leftS)} left`}`
      : list.is_armed ? "Waits for contact" : now ? `Next, ${list.next_index + 1} of ${count}` : "List of trials");
    setText(this.name, list.running_name ?? list.next_name ?? `all ${count} done or skipped`);
    setText(this.tags, now?.tags.join(", ") ?? "");
    setData(this.element, "state", isRunning ? "recording" : list.is_armed ? "armed" : now ? "next" : "done");
    setText(this.record.firstElementChild, list.is_armed ? "Do not wait" : list.start_at_contact ? "Record at contact" : "Record next");
    this.record.className = list.is_armed ? "" : "primary";
    this.record.disabled = !list.is_armed && (isRunning || list.next_name === null || Boolean(this.cannotRecord()));
    this.skip.disabled = list.next_name === null;
    this.repeat.disabled = list.last_index === null || list.last_index === list.next_index;
  }

  /** Make the item of a menu that opens the list. */
  makeItem() {
    const item = el("button", { type: "button", text: "Trial list …" });
    item.disabled = !this.list;
    item.addEventListener("click", () => quietly(async () => {
      const { openTrials } = await loadModule(() => import("./trials_dialog.js"));
      openTrials(this);
    }));
    return item;
  }
}
