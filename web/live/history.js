// History: the seconds before the first live message, from the server.
//
// It ends before the first frame number of the latest live message, so that both join by number; for
// an offline node it ends with the stream.

import * as api from "../common/api.js";
import { unlessRefused } from "../common/request.js";

/** Requests history when the trace has a hole. */
export class History {
  /** `currentStream()` returns the stream_id of the stream on display. */
  constructor(points, currentStream) {
    this.points = points;
    this.currentStream = currentStream;
    this.isRequested = true;
    this.tiles = null; // tile column of the last request
  }

  /** Request history with the next message: page opened, link restored, or longer window. */
  request() {
    this.isRequested = true;
  }

  /** Load history if requested; runs with each message, or without one while there is none. `tiles`: column per tile, or null. */
  async update(node, frame, seconds, nowMs, tiles) {
    if (tiles && tiles !== this.tiles) this.isRequested = true;
    if (!this.isRequested || (node.connected && !frame)) return;
    this.isRequested = false;
    this.tiles = tiles;
    const recent = await unlessRefused(api.recent(node.node, seconds, frame?.seq_first, tiles)); // refused: the trace starts empty
    if (!recent || recent.stream_id !== this.currentStream()) return;
    this.points.addHistory(recent, frame?.seq_first, nowMs);
    if (recent.tiles) this.points.addTileHistory(recent.tiles, tiles, frame?.seq_first);
  }
}
