// Warning about another machine that requests to connect under the name of a node.

import * as api from "./api.js";
import { ask } from "./dialogs.js";
import { notice, quietly } from "./notices.js";
import { el, setText } from "./text.js";

/** Warning with a button to accept the machine. */
export class ReplacementWarning {
  constructor() {
    /** @type {{node: string, replacement: ReplacementView | null} | null} */
    this.node = null;
    this.text = el("span");
    const accept = el("button", { type: "button", cls: "small requires-operator", text: "Accept …" });
    accept.addEventListener("click", () => quietly(() => this.accept()));
    this.element = el("p", { cls: "replacement", role: "status" }, this.text, " ", accept);
    this.element.hidden = true;
  }

  /** Update the warning. @param {{node: string, replacement: ReplacementView | null} | null} node */
  draw(node) {
    this.node = node;
    const request = node?.replacement;
    this.element.hidden = !request;
    setText(this.text, request
      ? `Another machine requests to connect as ${node.node}: ${request.fingerprint} from ${request.address}. Accept it only if ${node.node} or its storage was replaced.` : "");
  }

  async accept() {
    const { node, replacement } = this.node;
    const text = `Machine ${replacement.fingerprint} becomes ${node}; the previous machine is disconnected and refused. `
      + "Accept it only if it prints this fingerprint.";
    if (!await ask(`Accept another machine as ${node}?`, text, "Accept")) return;
    await api.acceptReplacement(node, replacement.fingerprint);
    notice(`${replacement.fingerprint} is now ${node}.`);
  }
}
