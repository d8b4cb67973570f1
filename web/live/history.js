// What the server remembers of the time before, asked for when the trace could begin with it.
//
// It is asked for up to the first number of a live message that has just come, so that both join by
// number; of a node that is away, up to its end.

import * as api from "../common/api.js";

export class History {
  /** `present()` is the stream that is shown now, by its boot_id. */
  constructor(points, present) {
    this.points = points;
    this.present = present;
    this.wanted = true;
    this.tiles = null; // what of each tile was asked for last
  }

  /** The picture has a hole: it was just opened, the link was down, or more time is to be seen. */
  want() {
    this.wanted = true;
  }

  /** Called with each message, and without one while there is none; `tiles`: what is drawn of each, or null. */
  async see(node, frame, seconds, nowMs, tiles) {
    if (tiles && tiles !== this.tiles) this.wanted = true;
    if (!this.wanted || (node.connected && !frame)) return;
    this.wanted = false;
    this.tiles = tiles;
    try {
      const recent = await api.recent(node.node, seconds, frame?.seq_first, tiles);
      if (recent.boot_id !== this.present()) return;
      this.points.precede(recent, frame?.seq_first, nowMs);
      if (recent.tiles) this.points.precedeTiles(recent.tiles, tiles, frame?.seq_first);
    } catch (error) {
      if (!(error instanceof api.Refusal)) throw error; // without it the trace begins empty
    }
  }
}
