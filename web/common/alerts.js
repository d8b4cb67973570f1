// Alerts by sound and vibration: a node is lost, a tile saturates, a recording ends by itself.

import { ownStops } from "./api.js";
import { isChosen, storeChoice } from "./choice.js";
import { isShown, notice, withdraw } from "./notices.js";
import { localTime } from "./text.js";

const AGAIN_MS = 5000; // least time between two alerts of a kind, and two lines of a reason
const LINES_MAX = 4;
const ABOUT = "alert";
const VOLUME = 0.4;
/** Tones [Hz, s] with pauses between, and vibration in ms on and off, by kind. */
const PATTERNS = {
  lost: { tones: [[880, 0.18], [660, 0.18], [440, 0.36]], buzz: [400, 150, 400, 150, 400] },
  saturated: { tones: [[1320, 0.1], [1320, 0.1]], buzz: [120, 80, 120] },
  ended: { tones: [[520, 0.5]], buzz: [700] },
};
const GAP_S = 0.06;

/** Alerts of this device. */
export class Alerts {
  /** @param {import("./absence.js").Absence} known what the page knew before each message: watches after this one */
  constructor(known) {
    this.known = known;
    /** @type {Record<"sound" | "vibration", boolean>} */
    this.on = { sound: isChosen("foottile.sound"), vibration: isChosen("foottile.vibration") };
    this.canVibrate = "vibrate" in navigator;
    this.audio = null;
    this.lastMs = {}; // latest alert by kind, and latest line by reason
    this.lines = []; // reasons, until the notice is dismissed
    this.saturated = new Map(); // name of the node -> latest frame's `saturated`
    // Browsers mute sound until the first tap or key.
    for (const type of ["pointerup", "keydown"]) document.addEventListener(type, () => { if (this.on.sound) this.unlock(); });
  }

  /** Turn a way of alerting on or off; on: play one as a trial. @param {"sound" | "vibration"} way @param {boolean} on */
  choose(way, on) {
    this.on[way] = on;
    storeChoice(`foottile.${way}`, on);
    if (!on) return;
    if (way === "sound") this.sound(PATTERNS.ended.tones);
    else navigator.vibrate(PATTERNS.ended.buzz);
  }

  /** State of the sound in words. */
  get soundState() {
    return !this.on.sound ? "off" : this.audio?.state === "running" ? "on" : "on, after a tap on this page";
  }

  unlock() {
    this.audio ??= new AudioContext();
    if (this.audio.state !== "running") this.audio.resume();
  }

  sound(tones) {
    this.unlock();
    let atS = this.audio.currentTime + 0.02;
    for (const [hz, lengthS] of tones) {
      const tone = this.audio.createOscillator();
      const level = this.audio.createGain();
      level.gain.value = VOLUME;
      tone.type = "square"; // heard outdoors
      tone.frequency.value = hz;
      tone.connect(level).connect(this.audio.destination);
      tone.start(atS);
      tone.stop(atS + lengthS);
      atS += lengthS + GAP_S;
    }
  }

  /** Return true at most every few seconds. */
  isDue(what) {
    const nowMs = performance.now();
    if (nowMs - (this.lastMs[what] ?? -Infinity) < AGAIN_MS) return false;
    this.lastMs[what] = nowMs;
    return true;
  }

  /** Alert once, and show the reason until it is dismissed. */
  raise(kind, reason) {
    if (!this.on.sound && !this.on.vibration || !this.isDue(reason)) return;
    if (this.isDue(kind)) {
      if (this.on.sound) this.sound(PATTERNS[kind].tones);
      if (this.on.vibration && this.canVibrate) navigator.vibrate(PATTERNS[kind].buzz);
    }
    if (!isShown(ABOUT)) this.lines = [];
    this.lines = [...this.lines, `${localTime(new Date()).slice(11)} ${reason}`].slice(-LINES_MAX);
    withdraw(ABOUT);
    notice(this.lines.join(" "), { stays: true, about: [ABOUT] });
  }

  /** Compare a message of the server with the ones before. @param {PageMessage} message */
  watch(message) {
    const { nodes, sessions } = this.known; // what changed before a hello is not of now: absence.js
    if (message.type === "node") {
      const { node } = message;
      if (nodes.get(node.node)?.connected && !node.connected) this.raise("lost", `Node ${node.node} is lost.`);
    } else if (message.type === "frame") {
      const before = this.saturated.get(message.node);
      this.saturated.set(message.node, message.saturated);
      const found = message.saturated.findIndex((is, i) => is && !before?.[i]);
      if (found >= 0) this.raise("saturated", `Tile ${nodes.get(message.node)?.tiles[found]?.serial ?? found} of ${message.node} is saturated.`);
    } else if (message.type === "session") {
      const { session } = message;
      if (session.state !== "recording" && sessions.has(session.id) && !ownStops.has(session.id) && !ownStops.has(session.take)) {
        this.raise("ended", `Recording “${session.name}” of ${session.node} has ended.`);
      }
    }
  }
}
