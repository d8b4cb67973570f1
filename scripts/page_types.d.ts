// Written by tests/test_docs.py.

type AcceptReplacementRequest = {
  fingerprint: string;
};

type AddMarker = {
  label: string;
  t_ns?: number | null;
  id?: string | null;
};

type AlignVideo = {
  method: "hand" | "contact";
  pairs: Array<PairOfInstants>;
};

type Alignment = {
  method: "light" | "clock" | "contact" | "hand";
  film_s: number;
  t_ns: number;
  drift: number;
  sigma_ns: number;
  sigma_drift: number;
  pair_count: number;
  rejected_count: number;
};

type ArrayView = {
  session_id: string;
  node: string;
  tiles: Array<TileView>;
  servo: ServoInfo | null;
  nominal_rate_hz: number;
  calibration: CalibrationView | null;
  tares: Array<SessionTareView>;
  lag_ms: number | null;
  estimates_problem: string | null;
};

type AssignCalibration = {
  id: string;
};

type BandView = {
  gauge_kpa: number;
  force_n: number;
  half_width_n: number;
};

type BinsView = {
  session_id: string;
  begin_t_ns: number;
  duration_s: number;
  frames_in_bin: number;
  columns: Record<string, Array<number | null>>;
};

type BytesPatch = {
  at: number;
  hex: string;
};

type CalibrationSummaryView = {
  id: string;
  name: string;
  reference: string;
  date: string;
  serials: Array<string>;
  refused: Array<string>;
  absolute_scale: "measured" | "assumed";
  mounted: boolean;
};

type CalibrationView = {
  id: string;
  name: string;
  absolute_scale: "measured" | "assumed";
};

type ChangeMarker = {
  label?: string | null;
  t_ns?: number | null;
};

type ChangeSession = {
  name?: string | null;
  subject?: string | null;
  notes?: string | null;
  tags?: Array<string> | null;
};

type ChangeTrials = {
  next_index?: number;
  node?: string | null;
  start_at_contact?: boolean;
  stop_after_s?: number | null;
  is_armed?: false;
};

type ClockSummary = {
  streams: Array<StreamSummary>;
};

type ClockView = {
  t_mono_ns: number;
  server_minus_node_ns: number;
  uncertainty_ns: number;
};

type ComparisonView = {
  name: string;
  problem: string | null;
  matches_current_data: boolean | null;
  missed: Array<string>;
};

type ComparisonsView = {
  items: Array<ComparisonView>;
};

type CurveView = {
  number: number;
  grf_n: Array<number | null>;
  cop_x_m: Array<number | null>;
  cop_y_m: Array<number | null>;
};

type DriftView = {
  kpa_per_hour: Array<number | null>;
  sigma_kpa_per_hour: Array<number | null>;
  n_per_hour: Array<number | null>;
  grf_n_per_hour: number | null;
  kelvin_per_hour: Array<number | null>;
  kelvin_since_tare: Array<number | null>;
  kpa_since_tare: Array<number | null>;
  grf_n_since_tare: number | null;
};

type Emptied = {
  sessions: number;
  bytes: number;
};

type FilmInfo = {
  codec: string;
  width_px: number;
  height_px: number;
  rotation_deg: number;
  picture_count: number;
  duration_s: number;
  rate_hz: number;
  play_rate_hz: number;
  is_variable: boolean;
  capture_rate_hz: number | null;
  hidden_count?: number | null;
  patch?: BytesPatch | null;
};

type FitView = {
  id: string;
  name: string;
  sessions: Array<string>;
  state: "running" | "done" | "failed" | "cancelled";
  started_t_ns: number;
  ended_t_ns: number | null;
  log: Array<string>;
  calibration_id: string | null;
  problem: string | null;
};

type FormatView = {
  name: string;
  title: string;
  opened_by: string;
  ending: string;
  media_type: string;
  options: Array<string>;
  takes_columns: boolean;
  needs_forces: boolean;
  needs_sealed: boolean;
  can_hold_several_sessions: boolean;
  frames_max: number | null;
  missing: string | null;
};

type FormatsView = {
  items: Array<FormatView>;
};

type FrameMessage = {
  type: "frame";
  node: string;
  seq_first: number;
  seq: number;
  t_ns: number;
  n: number;
  frame_flags: number;
  tile_flags: Array<number>;
  estimate_flags: number;
  contact: boolean | null;
  saturated: Array<boolean>;
  servo_age_us: number | null;
  angle_rad: number | null;
  gauge_kpa: Array<number | null>;
  gauge_min_kpa: Array<number | null>;
  gauge_max_kpa: Array<number | null>;
  force_n: Array<number | null>;
  force_sigma_n: Array<number | null>;
  force_min_n: Array<number | null>;
  force_max_n: Array<number | null>;
  grf_n: number | null;
  grf_sigma_n: number | null;
  grf_min_n: number | null;
  grf_max_n: number | null;
  grf_lower_bound_n: number | null;
  grf_lower_bound_max_n: number | null;
  cop_x_m: number | null;
  cop_y_m: number | null;
  cop_sigma_x_m: number | null;
  cop_sigma_y_m: number | null;
  age_ms: number | null;
};

type FramesDropped = {
  type: "dropped";
  node: string;
  from_seq: number;
  to_seq: number;
};

type Health = {
  status: string;
  problems: Array<string>;
};

type Heartbeat = {
  type: "heartbeat";
  t_ns: number;
  last_seq: number | null;
  nodes: Record<string, NodeCounts>;
};

type IndexView = {
  software: string;
  docs: string;
  openapi: string;
  live: string;
  ingest: string;
  routes: Array<RouteView>;
};

type Ledger = {
  complete: boolean;
  lossy: boolean;
  parts: Array<PartLedger>;
  missed_slots: number;
};

type ListedTrial = {
  name: string;
  tags?: Array<string>;
  subject?: string;
  notes?: string;
};

type LogIn = {
  ticket?: string | null;
};

type LoginView = {
  private: boolean;
  role: "viewer" | "operator" | null;
  ended: boolean;
  ends_t_ns: number | null;
};

type MarkerView = {
  id: string;
  label: string;
  t_ns: number;
  stream_id: string | null;
  t_mono_ns: number | null;
  bound_ns: number | null;
  revision: string;
};

type NewTicket = {
  role?: "viewer" | "operator";
};

type NodeCalibrationView = {
  node: string;
  source: "node" | "server";
  assigned_t_ns: number | null;
  calibration: CalibrationView | null;
  problem: string | null;
  own_id: string | null;
};

type NodeChanged = {
  type: "node";
  node: NodeView;
};

type NodeCounts = {
  connected: boolean;
  rate_hz: number | null;
  lost_frames: number;
  backlog_frames: number;
  missed_slots: number;
  last_seq: number | null;
};

type NodeView = {
  connected: boolean;
  rate_hz: number | null;
  lost_frames: number;
  backlog_frames: number;
  missed_slots: number;
  last_seq: number | null;
  node: string;
  stream_id: string;
  scene: string;
  emulated: boolean;
  tiles: Array<TileView>;
  servo: ServoInfo | null;
  schedule: string;
  nominal_rate_hz: number;
  calibration: CalibrationView | null;
  calibration_source: "node" | "server";
  calibration_problem: string | null;
  tare: TareView | null;
  tare_problem: string | null;
  tare_warnings: Array<string>;
  auto_tare: "on" | "paused" | "off";
  drift: DriftView;
  storage_problem: string | null;
  clock: ClockView | null;
  clock_set: boolean;
  lost: Record<string, number>;
  warnings: Array<string>;
  compiling: boolean;
  fault_counts: Record<string, Record<string, number>>;
  vitals: Vitals | null;
  last_t_ns: number | null;
  last_seen_t_ns: number | null;
  recording: Array<string>;
  replacement: ReplacementView | null;
};

type NodeWeighingView = {
  node: string;
  weighing: WeighingView | null;
};

type OverlayView = {
  session_id: string;
  points: number;
  whole: number;
  overlaid: number;
  not_whole: number;
  too_short: number;
  spread: Record<string, SpreadView>;
  curves: Array<CurveView>;
};

type OverviewView = {
  session_id: string;
  begin_t_ns: number;
  duration_s: number;
  frames_in_bin: number;
  columns: Record<string, Array<number | null>>;
  time_axis: Array<PartShift>;
  serials: Array<string>;
  counts_fall: Array<boolean>;
  provisional: boolean;
  catching_up: boolean;
};

type PageHello = {
  type: "hello";
  protocol: 1;
  software: string;
  t_ns: number;
  problems: Array<string>;
  nodes: Array<NodeView>;
  recording: Array<SessionView>;
  trials: TrialsView;
};

type PageMessage = PageHello | NodeChanged | SessionChanged | SessionDeleted | SessionsProgress | TrialsChanged | Heartbeat | FramesDropped | FrameMessage | Pong;

type Page_CalibrationSummaryView_ = {
  items: Array<CalibrationSummaryView>;
  next_cursor: string | null;
};

type Page_FitView_ = {
  items: Array<FitView>;
  next_cursor: string | null;
};

type Page_MarkerView_ = {
  items: Array<MarkerView>;
  next_cursor: string | null;
};

type Page_NodeView_ = {
  items: Array<NodeView>;
  next_cursor: string | null;
};

type Page_SessionView_ = {
  items: Array<SessionView>;
  next_cursor: string | null;
};

type PairOfInstants = {
  film_s: number;
  t_ns: number;
  sigma_ns: number;
};

type Part = {
  stream_id: string;
  seq_first: number;
  seq_last?: number | null;
};

type PartLedger = {
  stream_id: string;
  seq_first: number;
  seq_last: number;
  recorded: number;
  lost: Record<string, number>;
  pending: number;
  max_lost_tail_frames?: number;
};

type PartShift = {
  part: number;
  shift_ns: number;
  by: "node" | "server" | "joined";
};

type Pong = {
  type: "pong";
  t_ms: number;
  t_ns: number;
};

type Ready = {
  ready: boolean;
  nodes_connected: number;
  subscribers: number;
};

type RecentTilesView = {
  seq_first: Array<number>;
  seq: Array<number>;
  n: Array<number>;
  t_ns: Array<number>;
  min: Array<Array<number | null>>;
  max: Array<Array<number | null>>;
};

type RecentView = {
  node: string;
  stream_id: string;
  age_ms: number | null;
  seq_first: Array<number>;
  seq: Array<number>;
  n: Array<number>;
  t_ns: Array<number>;
  grf_n: Array<number | null>;
  grf_min_n: Array<number | null>;
  grf_max_n: Array<number | null>;
  grf_lower_bound_max_n: Array<number | null>;
  tiles: RecentTilesView | null;
};

type RecordTrial = {
};

type RepeatabilityView = {
  mean_kpa: number;
  spread_kpa: number;
  settle_kpa: number;
};

type ReplacementView = {
  fingerprint: string;
  address: string;
  requested_t_ns: number;
};

type ReportView = {
  name: string;
  problem: string | null;
  matches_current_data: boolean | null;
  missed: Array<string>;
  has_series: boolean;
  report: Record<string, any>;
};

type RouteView = {
  method: string;
  href: string;
  operation: string;
  summary: string;
};

type ServoInfo = {
  model: string;
  counts_per_turn: number;
  zero_counts: number;
  sign: -1 | 1;
  ratio: number;
  ankle_travel_m_per_rad: number | null;
};

type SessionChanged = {
  type: "session";
  session: SessionView;
};

type SessionDeleted = {
  type: "deleted";
  session_id: string;
};

type SessionPage = {
  items: Array<SessionView>;
  next_cursor: string | null;
  unreadable: Record<string, string>;
};

type SessionProgress = {
  frames: number;
  pending_frames: number;
  pending_reason: "frames" | "end" | null;
  lost: Record<string, number>;
  missed_slots: number;
  not_sampled_share: number;
  duration_s: number;
};

type SessionTareView = {
  t_ns: number;
  source: "interval" | "lead" | "recognised" | "unloaded" | "flight" | "lost";
};

type SessionView = {
  frames: number;
  pending_frames: number;
  pending_reason: "frames" | "end" | null;
  lost: Record<string, number>;
  missed_slots: number;
  not_sampled_share: number;
  duration_s: number;
  id: string;
  name: string;
  node: string;
  state: "recording" | "pending" | "sealing" | "sealed";
  complete: boolean | "lossy";
  started_t_ns: number;
  stopped_t_ns: number | null;
  max_lost_tail_frames: number;
  marker_count: number;
  vitals_at_start: Vitals | null;
  vitals_at_stop: Vitals | null;
  bytes: number | null;
  sha256: string | null;
  parts: Array<Part>;
  subject: string;
  notes: string;
  tags: Array<string>;
  take: string | null;
  scene: string;
  calibration_id: string | null;
  calibration_source: "node" | "server";
  absolute_scale: "measured" | "assumed" | null;
  problem: string | null;
  revision: string;
};

type SessionsProgress = {
  type: "session_progress";
  sessions: Record<string, SessionProgress>;
};

type SpreadView = {
  mean: Array<number | null>;
  sd: Array<number | null>;
  count: Array<number>;
};

type StanceView = {
  number: number;
  part: number;
  begin_t_ns: number;
  end_t_ns: number;
  duration_s: number;
  duration_sigma_s: number | null;
  peak_grf_n: number | null;
  peak_t_ns: number | null;
  peak_sigma_n: number | null;
  impulse_n_s: number | null;
  impulse_sigma_n_s: number | null;
  cop_x_first_m: number | null;
  cop_x_last_m: number | null;
  cop_x_range_m: number | null;
  cop_x_range_sigma_m: number | null;
  frames: number;
  unknown_frames: number;
  missing_frames: number;
  gap_s: number;
  estimate_flags: number;
  begun: boolean;
  ended: boolean;
  is_whole: boolean;
};

type StartFit = {
  sessions: Array<string>;
  name: string;
  reference?: string;
  reference_delay_ms?: number | null;
  reference_delay_sigma_ms?: number;
};

type StartSession = {
  name: string;
  pre_roll_s?: number;
  subject?: string | null;
  notes?: string;
  tags?: Array<string>;
  node: string;
};

type StartTake = {
  name: string;
  pre_roll_s?: number;
  subject?: string | null;
  notes?: string;
  tags?: Array<string>;
  nodes?: Array<string> | null;
};

type StartWeighing = {
  tiles: Array<string>;
  weights: Array<string>;
  within_percent?: number;
  method?: "weights" | "scale" | "sensor";
  reference?: string | null;
  name?: string | null;
};

type StepSummary = {
  after_t_ns: number | null;
  before_t_ns: number | null;
  jump_ns: number;
  jump_uncertainty_ns: number;
};

type StreamSummary = {
  stream_id: string;
  state: "measured" | "unmeasured" | "unsynchronised";
  rows: number;
  stretches: Array<StretchSummary>;
  steps: Array<StepSummary>;
};

type StretchSummary = {
  begin_t_ns: number | null;
  end_t_ns: number | null;
  rows: number;
  offset_ns: number;
  uncertainty_ns: number;
  drift_ppm: number | null;
  drift_uncertainty_ppm: number | null;
};

type TakeView = {
  id: string;
  sessions: Array<SessionView>;
  failed: Record<string, string>;
};

type TareRequest = {
  reason?: string;
};

type TareView = {
  id: string;
  t_ns: number;
  source: "interval" | "lead" | "recognised" | "unloaded" | "flight";
  reason: string;
  frames: number;
  baseline_kpa: Array<number>;
  baseline_sigma_kpa: Array<number>;
  noise_kpa: Array<number>;
  temperature_raw_counts: Array<number>;
  undone: boolean;
};

type TaresPage = {
  items: Array<TareView>;
  next_cursor: string | null;
  drift: DriftView;
};

type TicketView = {
  ticket: string;
  role: "viewer" | "operator";
  ends_t_ns: number;
  urls: Array<string>;
};

type TilePassView = {
  serial: string;
  held: Array<RepeatabilityView>;
};

type TileResultView = {
  serial: string;
  weights: Array<WeightResultView>;
  band: Array<BandView>;
};

type TileView = {
  serial: string;
  mux: number;
  channel: number;
  x_m: number;
  y_m: number;
  z_m: number;
  reference: boolean;
  range_kpa: [number, number] | null;
  full_scale_n: number | null;
};

type TimesView = {
  film_s: Array<number>;
  whole_s?: Array<number> | null;
};

type TrialList = {
  trials: Array<ListedTrial>;
};

type TrialView = {
  name: string;
  tags: Array<string>;
  subject: string;
  notes: string;
  state: "open" | "skipped" | "recording" | "pending" | "complete" | "lossy";
  recordings: number;
  sessions: Array<string>;
  not_sampled_share: number;
};

type TrialsChanged = {
  type: "trials";
  trials: TrialsView;
};

type TrialsView = {
  trials: Array<TrialView>;
  text: string;
  next_index: number;
  next_name: string | null;
  last_index: number | null;
  node: string | null;
  start_at_contact: boolean;
  stop_after_s: number | null;
  is_armed: boolean;
  take: string | null;
  running_name: string | null;
  stop_at_t_ns: number | null;
  problem: string | null;
};

type VerificationView = {
  complete: boolean;
  lossy: boolean;
  parts: Array<PartLedger>;
  missed_slots: number;
  id: string | null;
  problems: Array<string>;
  sha256: string | null;
};

type Version = {
  software: string;
  api: string;
  protocol: string;
};

type Video = {
  id: string;
  name: string;
  suffix: string;
  size_bytes: number;
  sha256: string;
  times_sha256: string;
  added_t_ns: number;
  film: FilmInfo;
  alignment?: Alignment | null;
};

type VideosView = {
  items: Array<Video>;
  problems: Array<string>;
};

type Vitals = {
  disk_free_bytes?: number | null;
  recording_left_s?: number | null;
  cpu_celsius?: number | null;
  is_undervolted?: boolean | null;
  was_undervolted?: boolean | null;
  is_throttled?: boolean | null;
  was_throttled?: boolean | null;
  load_per_core?: number | null;
  wifi_dbm?: number | null;
  is_clock_synchronised?: boolean | null;
  clock_error_max_s?: number | null;
};

type WeighingResultView = {
  calibration_id: string;
  name: string;
  date: string;
  tiles: Array<TileResultView>;
  refused: Record<string, string>;
  misfit: string | null;
};

type WeighingView = {
  session_id: string;
  state: "weighing" | "fitting" | "done" | "failed";
  tiles: Array<TilePassView>;
  weights: Array<string>;
  method: "weights" | "scale" | "sensor";
  reference: string;
  name: string;
  tile: string;
  step: "empty" | "resting" | "put on" | "holding" | "done";
  prompt: string;
  left_s: number | null;
  warning: string | null;
  problem: string | null;
  pressure_kpa: number | null;
  recent_kpa: Array<number>;
  rest_kpa: number | null;
  repeatability: RepeatabilityView | null;
  result: WeighingResultView | null;
};

type WeightResultView = {
  weight: string;
  force_n: number;
  gauge_kpa: number;
  noise_kpa: number;
  settle_kpa: number;
  residual_n: number;
  half_width_n: number;
};
