// A warning that another machine asks to connect under the name of a node, and a button that accepts it.

import * as api from "./api.js";
import { ask } from "./dialogs.js";
import { notice, quietly } from "./notices.js";
import { el, setText } from "./text.js";

export class ReplacementWarning {
  constructor() {
    /** @type {{node: string, replacement: Replacement | null} | null} */
    this.node = null;
    this.text = el("span");
    const accept = el("button", { type: "button", cls: "small presses", text: "Accept it …" });
    accept.addEventListener("click", () => quietly(() => this.accept()));
    this.element = el("p", { cls: "replacement", role: "status" }, this.text, " ", accept);
    this.element.hidden = true;
  }

  /** Called often. @param {{node: string, replacement: Replacement | null} | null} node */
  draw(node) {
    this.node = node;
    const asking = node?.replacement;
    this.element.hidden = !asking;
    setText(this.text, asking
      ? `Another machine asks to connect as ${node.node}: ${asking.fingerprint}, from ${asking.address}. If the storage of ${node.node} was replaced, accept it.` : "");
  }

  async accept() {
    const { node, replacement } = this.node;
    const means = `From now on the machine ${replacement.fingerprint} is ${node}. The one that was ${node} before is disconnected and refused. `
      + "Accept it only if it prints this fingerprint.";
    if (!await ask(`Accept another machine as ${node}?`, means, "Accept it")) return;
    await api.acceptReplacement(node, replacement.fingerprint);
    notice(`${replacement.fingerprint} is ${node} from now on`);
  }
}
