// Written from devices/flags.py; change it there.

export const TILE = { NO_ANSWER: 1, STALE: 2, RETRIED: 4, IMPLAUSIBLE: 8, OVER_RANGE: 16, NOT_CONVERTED: 32 };
/** @type {[bit: number, title: string, severity: string][]} titled, in their order */
export const TILE_FLAGS = [
  [1, "no answer", "unknown"],
  [2, "stale", "unknown"],
  [8, "implausible", "unknown"],
  [32, "not converted", "unknown"],
];
export const FRAME = { OVERRUN: 1, SERVO_STALE: 2, BUS_FAULT: 4, LEAD: 8, NEW_ARRAY_INFO: 16, SERVO_TURN_UNKNOWN: 32 };
/** @type {[bit: number, title: string, severity: string][]} titled, in their order */
export const FRAME_FLAGS = [
  [4, "bus fault", "unknown"],
  [1, "node late: no frames sampled just before", "note"],
  [2, "servo angle stale", "note"],
  [32, "servo turn unknown", "note"],
  [8, "unloaded lead-in", "note"],
  [16, "array scanned again", "note"],
];
export const ESTIMATE = { SATURATED: 1, EXTRAPOLATED: 2, OUTLIER_REPLACED: 4, GAP: 8, COP_MASKED: 16, TILE_MISSING: 32, ASSUMED_SCALE: 64, TARE_OLD: 128, OVER_RATED: 256, TARE_LOST: 512, AFTER_SATURATION: 1024, STUCK: 2048, CLIPPED: 4096, BASELINE_LOST: 8192, HISTORY_UNKNOWN: 16384 };
/** @type {[bit: number, title: string, severity: string][]} titled, in their order */
export const ESTIMATE_FLAGS = [
  [1, "tile saturated", "bound"],
  [4096, "tile clipped below its range", "bound"],
  [32, "tile missing", "unknown"],
  [2048, "tile stuck", "unknown"],
  [512, "tare lost", "unknown"],
  [2, "a tile below its calibrated range (suction or old tare)", "doubt"],
  [128, "tare in doubt", "doubt"],
  [8192, "zero of a tile has dropped", "doubt"],
  [1024, "less certain: a tile saturated or not read just before", "doubt"],
  [16384, "less certain: loads before the first frame are not known", "doubt"],
  [256, "above the rated pressure", "doubt"],
  [4, "outlier replaced", "note"],
  [64, "scale assumed", "note"],
];
