// Dialog of the list of trials: all rows, the text of the list, and its settings.

import * as api from "./api.js";
import { missedText } from "./losses.js";
import { unlessRefused } from "./request.js";
import { el, setText } from "./text.js";

const SIGNS = { open: "", skipped: "skipped", recording: "● recording", pending: "… pending", complete: "✓ complete", lossy: "⚠ lossy" };

/** Show the dialog until it is closed. @param {import("./trials.js").Trials} trials */
export function openTrials(trials) {
  const rows = el("ol", { id: "trials-rows" });
  const said = el("p", { id: "trials-said", role: "alert" });
  const text = el("textarea", { id: "trials-text", rows: 5, cls: "requires-operator", "aria-label": "List as text: a trial a line, name; tag, tag", placeholder: "mud 1; wet, deep\nmud 2, mud 3, plate 1" });
  const file = el("input", { type: "file", accept: ".txt,.csv,text/plain", "aria-label": "List from a file" });
  file.addEventListener("change", async () => {
    const [chosen] = file.files ?? [];
    if (chosen) text.value = decodeText(await chosen.arrayBuffer());
  });
  const use = el("button", { type: "button", id: "trials-use", text: "Use this list" });
  use.addEventListener("click", () => tell(async () => {
    const list = await api.setTrials(text.value);
    drawnText = text.value;
    return list;
  }));
  const contact = el("input", { type: "checkbox", id: "trials-contact" });
  const stop = el("input", { type: "number", id: "trials-stop", min: 1, max: 3600, step: "any", placeholder: "never" });
  const node = el("select", { id: "trials-node" });
  contact.addEventListener("change", () => change({ start_at_contact: contact.checked }));
  stop.addEventListener("change", () => change({ stop_after_s: stop.value === "" ? null : Number(stop.value) }));
  node.addEventListener("change", () => change({ node: node.value || null }));
  const dialog = el("dialog", { id: "trials-dialog", "aria-labelledby": "trials-title" }, el("form", { method: "dialog" },
    el("h2", { id: "trials-title", text: "Trial list" }), rows, said, text,
    el("p", { cls: "row requires-operator" }, use, file),
    el("fieldset", { cls: "requires-operator" }, el("label", {}, contact, " Start at contact, with 1 s before it"),
      el("label", {}, "Stop after ", stop, " s"), el("label", {}, "Record ", node)),
    el("p", { cls: "row" }, el("button", { type: "submit", value: "", text: "Close", autofocus: "" }))));
  let drawnText = "";
  document.body.append(dialog);
  dialog.addEventListener("close", () => {
    dialog.remove();
    trials.drawDialog = null;
  });
  dialog.showModal();
  trials.drawDialog = draw;
  draw();

  /** Run a change; a refusal is shown here, since the dialog covers the notices. @param {() => Promise<TrialsView>} send */
  async function tell(send) {
    setText(said, "");
    await unlessRefused(send().then((list) => trials.show(list)), ({ message }) => setText(said, message));
  }

  /** Send the one setting that was changed: another page may have changed the others. */
  function change(setting) {
    tell(() => api.changeTrials(setting));
  }

  /** Draw the present list, but not over what is being entered. */
  function draw() {
    const { list } = trials;
    rows.replaceChildren(...list.trials.map((row, i) => {
      const isNext = i === list.next_index;
      const named = row.recordings > 1 ? `${row.name} (${row.recordings})` : row.name;
      const name = row.sessions.length ? el("a", { href: `/sessions/${encodeURIComponent(row.sessions[0])}`, text: named }) : el("span", { text: row.name });
      return el("li", { "data-state": row.state, ...(isNext ? { "aria-current": "step" } : {}) }, name,
        el("span", { cls: "trial-row-tags", text: row.tags.join(", ") }), el("span", { cls: "trial-row-state", text: isNext ? "next" : [SIGNS[row.state], missedText(row)].filter(Boolean).join(", ") }));
    }));
    rows.querySelector("[aria-current]")?.scrollIntoView({ block: "center" });
    if (text.value === drawnText) text.value = list.text;
    drawnText = list.text;
    contact.checked = list.start_at_contact;
    if (stop !== document.activeElement) stop.value = String(list.stop_after_s ?? "");
    if (node === document.activeElement) return;
    const known = new Set([...document.querySelectorAll("#node-select option, .node h2 a")].map((one) => one.textContent).concat(list.node ?? []));
    node.replaceChildren(el("option", { value: "", text: "all connected nodes" }), ...[...known].map((name) => el("option", { value: name, text: name })));
    node.value = list.node ?? "";
  }
}

/** Return the text of a file as editors and spreadsheets save it: UTF-8, UTF-16, or else Windows' Latin. @param {ArrayBuffer} content */
function decodeText(content) {
  const head = new Uint8Array(content.slice(0, 2));
  const isWide = (low, high) => low === 0xff && high === 0xfe || low !== 0 && high === 0;
  if (isWide(head[0], head[1])) return new TextDecoder("utf-16le").decode(content);
  if (isWide(head[1], head[0])) return new TextDecoder("utf-16be").decode(content);
  try {
    return new TextDecoder("utf-8", { fatal: true }).decode(content);
  } catch {
    return new TextDecoder("windows-1252").decode(content);
  }
}
