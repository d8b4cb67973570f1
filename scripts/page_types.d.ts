// Types of the server's messages (docs/api.md) that the pages use: for `tsc --checkJs`, not for browsers.

interface Session {
  id: string; name: string; node: string; state: string; complete: boolean | "lossy"; problem: string | null;
  started_t_ns: number; stopped_t_ns: number | null; duration_s: number; frames: number; pending_frames: number;
  pending_reason: "frames" | "end" | null; lost: Record<string, number>; max_lost_tail_frames: number; missed_slots: number; marker_count: number;
  bytes: number | null; sha256: string | null; parts: object[]; subject: string; notes: string; tags: string[];
  take: string | null; scene: string; calibration_id: string | null; absolute_scale: "measured" | "assumed" | null;
  revision: string;
}

/** Recording of several nodes: a session each, or the reason of its failure. */
interface Take { id: string; sessions: Session[]; failed: Record<string, string> }

/** Of GET /calibrations. */
interface Calibration {
  id: string; name: string; date: string; serials: string[]; absolute_scale: "measured" | "assumed"; mounted: boolean;
}

/** Of GET /nodes/NODE/calibration. */
interface NodeCalibration {
  source: "node" | "server"; assigned_t_ns: number | null; problem: string | null; own_id: string | null;
  calibration: { id: string; name: string; absolute_scale: "measured" | "assumed" } | null;
}

/** Node as the page of the guided calibration uses it. */
interface LiveNode { node: string; connected: boolean; tiles: Tile[] }

/** Body of POST /nodes/NODE/weighing. */
interface WeighingPlan {
  tiles: string[]; weights: string[]; method: string; within_percent?: number; reference?: string; name?: string;
}

/** Pressure of a held weight: mean, spread and drift. */
interface Repeatability { mean_kpa: number; spread_kpa: number; settle_kpa: number }

/** Fitted curve of a tile. */
interface TileResult {
  serial: string; band: { gauge_kpa: number; force_n: number; half_width_n: number }[];
  weights: {
    weight: string; force_n: number; gauge_kpa: number; noise_kpa: number; settle_kpa: number; residual_n: number; half_width_n: number;
  }[];
}

/** Of GET /nodes/NODE/weighing. */
interface Weighing {
  session_id: string; state: "weighing" | "fitting" | "done" | "failed"; tiles: { serial: string; held: Repeatability[] }[];
  weights: string[]; method: string; reference: string; name: string; tile: string; step: string; prompt: string;
  left_s: number | null; warning: string | null; problem: string | null; pressure_kpa: number | null; recent_kpa: number[];
  rest_kpa: number | null; repeatability: Repeatability | null;
  result: {
    calibration_id: string; name: string; date: string; tiles: TileResult[]; refused: Record<string, string>; misfit: string | null;
  } | null;
}

/** Machine that requests to connect under the name of a node. */
interface Replacement { fingerprint: string; address: string }

interface Marker { id: string; label: string; t_ns: number; revision: string }

interface Tile {
  serial: string; x_m: number; y_m: number; z_m: number; reference?: boolean; full_scale_n?: number | null;
  range_kpa?: [number, number] | null;
}

/** Live message: latest frame, with min and max since the previous message. */
interface Frame {
  node?: string; seq: number; frame_flags: number; estimate_flags: number | null; contact: boolean | null;
  grf_n: number | null; grf_sigma_n: number | null; grf_lower_bound_n: number | null;
  force_n: (number | null)[]; force_sigma_n: (number | null)[]; gauge_kpa: (number | null)[]; tile_flags: (number | null)[];
  saturated: boolean[];
  /** On a session's page: seconds after its first frame. */
  timeS?: number;
  [more: string]: any;
}

/** Point of a trace on the live page. */
interface TilePoint { timeS: number; tiles: Record<string, (number | null)[]> | null; gap?: boolean }

/** Of GET /sessions/ID/tiles. */
interface ArrayInfo {
  node: string; tiles: Tile[]; servo: object | null; nominal_rate_hz: number; calibration: object | null; lag_ms: number | null;
  estimates_problem: string | null; tares: { t_ns: number; source: string }[];
}

interface Overview {
  begin_t_ns: number; duration_s: number; frames_in_bin: number; serials: string[]; provisional?: boolean; catching_up?: boolean;
  time_axis: { part: number; shift_ns: number; by: "node" | "server" | "joined" }[];
  columns: Record<string, (number | null)[]>;
}

type OverviewQuery = { points: number; start_s?: number; end_s?: number; columns?: string };

/** Of GET /sessions/ID/verification. */
interface Verified {
  complete: boolean; lossy: boolean; parts: { recorded: number }[]; sha256: string | null; problems: string[];
}

interface Clock { streams: { stretches: { begin_t_ns: number; end_t_ns: number; offset_ns: number; drift_ppm: number }[] }[] }

interface Estimate { value: number; interval_95: [number, number] }

/** Report of `foottile compare`: docs/compare.md. */
interface ComparisonReport {
  reference: string; limits?: Record<string, number>; notes: string[]; contact_n: number | null;
  figures: Record<string, { mean: number | null; interval_95: [number, number] | null; trials: number }>;
  alignment: { lag_s?: Estimate; scale?: Estimate; offset_in_flight_n?: Estimate; offset_removed?: boolean };
  trials?: object[]; trials_are?: string;
}
