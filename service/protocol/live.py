"""Messages of the live sockets, and the JSON shapes of nodes and sessions in them.

The live page gets `PageMessage`s. A program that requests every frame (`format=arrow`) gets
`FeedMessage`s as text; an Arrow schema and record batches are between them.
"""

from __future__ import annotations

from typing import Annotated, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter

from devices.frames import ServoInfo
from devices.types import StrictModel
from devices.vitals import Vitals
from service.estimation.tare.tare import IntervalSource
from service.protocol.link import StreamId
from service.user_folders import PublicText
from storage.sessions.folder import Part

LIVE_PATH = "/api/v1/live"
CalibrationSource = Literal["node", "server"]
AutoTareState = Literal["on", "paused", "off"]
TrialState = Literal["open", "skipped", "recording", "pending", "complete", "lossy"]
Policy = Literal["lossless", "drop_oldest", "latest"]


class View(BaseModel):
    """Base of answers and live messages; unknown values are null, never NaN."""

    model_config = ConfigDict(
        frozen=True,
        allow_inf_nan=False,
        from_attributes=True,
        json_schema_serialization_defaults_required=True,
    )


class TileView(View):
    """Tile of an array."""

    serial: str = Field(examples=["T01"])
    mux: int = Field(description="I2C address of its multiplexer.", examples=[112])
    channel: int
    x_m: float = Field(description="Position in the foot frame: forward.")
    y_m: float = Field(description="To the left.")
    z_m: float = Field(description="Along the segment, towards the ankle.")
    reference: bool = Field(description="A bare tile that bears no load.")
    range_kpa: tuple[float, float] | None = Field(
        description="Calibrated range of gauge pressure; above it force is a lower bound."
    )
    full_scale_n: float | None = Field(description="Force at the end of that range.")


class CalibrationView(View):
    """Calibration in use."""

    id: str
    name: str
    absolute_scale: Literal["measured", "assumed"]


class TareView(View):
    """Tare."""

    id: str
    t_ns: int = Field(description="End of the interval of the tare, node's UTC.")
    source: IntervalSource = Field(
        description="unloaded: by hand; flight: automatic; lead: of an emulation."
    )
    reason: str = Field(description="Reason, as text.")
    frames: int = Field(description="Number of frames in the interval.")
    baseline_kpa: list[float] = Field(description="Absolute unloaded pressure, by tile.")
    baseline_sigma_kpa: list[float] = Field(description="Its standard uncertainty.")
    noise_kpa: list[float] = Field(description="Standard deviation of one reading.")
    temperature_raw_counts: list[float] = Field(description="Mean temperature counts, by tile.")
    undone: bool


class DriftView(View):
    """Drift of the baselines. Lists are by tile; null where undetermined."""

    kpa_per_hour: list[float | None] = Field(
        description="Slope of the baselines over the last six hours; null under ten minutes."
    )
    sigma_kpa_per_hour: list[float | None] = Field(description="Its standard uncertainty.")
    n_per_hour: list[float | None] = Field(
        description="The same as force, near zero load; null without a calibration."
    )
    grf_n_per_hour: float | None = Field(description="Sum over the tiles that bear load.")
    kelvin_per_hour: list[float | None] = Field(
        description="Temperature drift of the chips, from the same tares."
    )
    kelvin_since_tare: list[float | None] = Field(
        description="Warming of the chips since the tare, by temperature counts."
    )
    kpa_since_tare: list[float | None] = Field(
        description="Expected shift of the baseline since the tare, from the warming of a sealed "
        "bubble."
    )
    grf_n_since_tare: float | None = Field(description="The same as a shift of the GRF.")


class ClockView(View):
    """Offset of the clocks, from the best of eight probes."""

    t_mono_ns: int = Field(description="Instant of that probe, by the clock of `t_mono_ns`.")
    server_minus_node_ns: int
    uncertainty_ns: int = Field(description="Half the round trip of that probe.")


class ReplacementView(View):
    """Machine that was refused because another one has the name of this node."""

    fingerprint: str = Field(
        description="Fingerprint, as the machine itself prints it.",
        examples=["3f2a-91bc-0d4e-77a1"],
    )
    address: str = Field(description="Peer address; behind a proxy the proxy's.")
    requested_t_ns: int = Field(description="Server's UTC.")


class NodeCounts(View):
    """Rate and losses of a node's present stream."""

    connected: bool
    rate_hz: float | None = Field(description="Frames per second over the last second.")
    lost_frames: int = Field(description="Lost frames of this stream.")
    backlog_frames: int = Field(
        description="Frames of this stream that the node still has, sent behind the newest."
    )
    missed_slots: int = Field(description="Slots that were not sampled in its present stream.")
    last_seq: int | None


class NodeView(NodeCounts):
    """Node, connected or remembered."""

    node: str = Field(examples=["demo"])
    stream_id: str = Field(
        description="Id of its present stream; a new one begins when the node or a "
        "replaced part restarts."
    )
    scene: str
    emulated: bool
    tiles: list[TileView]
    servo: ServoInfo | None
    schedule: str
    nominal_rate_hz: float
    calibration: CalibrationView | None
    calibration_source: CalibrationSource = Field(
        description="Origin: the node itself, or the server, where one was assigned."
    )
    calibration_problem: PublicText | None = Field(
        description="Reason why there is no calibration."
    )
    tare: TareView | None = Field(description="The tare in force.")
    tare_problem: PublicText | None = Field(
        description="Reason why there is none, or why the one in force is of another stream."
    )
    tare_warnings: list[str] = Field(
        description="Reasons why the tare in force may no longer fit, as text: age, temperature, "
        "or a baseline that does not fit the foot in the air."
    )
    auto_tare: AutoTareState = Field(
        description="State of automatic tares in flight. paused: a tare was undone, with no tare "
        "by hand since; off: the scene has `auto_tare = false`."
    )
    drift: DriftView
    storage_problem: PublicText | None = Field(description="Reason why frames cannot be stored.")
    clock: ClockView | None = Field(description="Null: not measured yet.")
    clock_set: bool = Field(description="True if the node's date had been set.")
    lost: dict[str, int] = Field(
        description="Lost frames of this stream, by reason.", examples=[{"evicted": 12}]
    )
    warnings: list[str] = Field(description="Present faults of its array or disk, as text.")
    compiling: bool = Field(
        description="Models are being compiled, once on this machine: frames have pressures only."
    )
    fault_counts: dict[str, dict[str, int]] = Field(
        description="Faults of this stream, counted by serial and reason."
    )
    vitals: Vitals | None = Field(
        description="Vitals of its machine, each few seconds; null: a value, or all, unknown."
    )
    last_t_ns: int | None
    last_seen_t_ns: int | None = Field(description="Arrival time of its last frame, server's UTC.")
    recording: list[str] = Field(description="Ids of sessions that are being recorded.")
    replacement: ReplacementView | None = Field(
        description="Machine that was refused because another one has this name. A person may "
        "accept it with `accept-replacement`."
    )


class SessionProgress(View):
    """Progress of an unsealed session, by the ledger."""

    frames: int
    pending_frames: int = Field(description="Still with the node.")
    pending_reason: Literal["frames", "end"] | None = Field(
        description="frames: `pending_frames` are still with the node; end: the last frames "
        "before the stop have not come; null: not pending."
    )
    lost: dict[str, int] = Field(description="Lost frames, by reason.", examples=[{"evicted": 12}])
    missed_slots: int = Field(
        description="Frames not sampled: slots that the node left out because it was late."
    )
    not_sampled_share: float = Field(description="Their share of all slots, 0 to 1.")
    duration_s: float


class SessionView(SessionProgress):
    """Recorded session."""

    id: str = Field(examples=["20261121T101500Z-1a2b3c"])
    name: str
    node: str
    state: Literal["recording", "pending", "sealing", "sealed"] = Field(
        description="pending: waits for the node (`pending_reason`), and completes by itself."
    )
    complete: bool | Literal["lossy"] = Field(
        description="true: it has every frame that was sampled; 'lossy': some are lost."
    )
    started_t_ns: int = Field(description="Server's UTC.")
    stopped_t_ns: int | None
    max_lost_tail_frames: int = Field(
        description="Upper bound of lost frames at an unknown end: the node lost power, or its "
        "frames were abandoned."
    )
    marker_count: int = Field(description="Number of its markers.")
    vitals_at_start: Vitals | None = Field(description="Vitals of its node at the start.")
    vitals_at_stop: Vitals | None = Field(description="Vitals of its node at the stop.")
    bytes: int | None = Field(description="Size of the sealed file.")
    sha256: str | None = Field(description="Hash of the sealed file.")
    parts: list[Part] = Field(description="Intervals of streams, both ends included.")
    subject: str
    notes: str
    tags: list[str]
    take: str | None = Field(
        description="Id of the take, if it was recorded together with other nodes."
    )
    scene: str
    calibration_id: str | None
    calibration_source: CalibrationSource = Field(
        description="Origin of the calibration: the node, or the server, where one was assigned."
    )
    absolute_scale: Literal["measured", "assumed"] | None
    problem: PublicText | None = Field(description="User-visible problem, if any.")
    revision: str = Field(
        description="Revision of name, subject, notes and tags: with another one in `If-Match` a "
        "change is refused (412)."
    )


class TrialView(View):
    """Row of the list of trials."""

    name: str
    tags: list[str]
    subject: str
    notes: str
    state: TrialState = Field(
        description="State of its latest recording; skipped: passed without one."
    )
    recordings: int = Field(description="Number of its recordings.")
    sessions: list[str] = Field(description="Ids of the sessions of its latest recording.")
    not_sampled_share: float = Field(description="Greatest share of them, of slots not sampled.")


class TrialsView(View):
    """List of trials."""

    trials: list[TrialView]
    text: str = Field(description="The list as text.")
    next_index: int = Field(description="Next row, from 0; the number of rows: none is left.")
    next_name: str | None = Field(
        description="Name of the next recording; a repeated trial has its number behind.",
        examples=["mud 1 (2)"],
    )
    last_index: int | None = Field(description="Row that was recorded last.")
    node: str | None = Field(description="Node to record; null: all connected ones.")
    start_at_contact: bool
    stop_after_s: float | None
    is_armed: bool = Field(description="True: the next trial begins when a contact begins.")
    take: str | None = Field(description="Id of the take of the running trial.")
    running_name: str | None = Field(
        description="Name of the running trial, also of one that is no longer in the list."
    )
    stop_at_t_ns: int | None = Field(description="Time at which that is stopped, server's UTC.")
    problem: PublicText | None = Field(
        description="Reason why a trial was not started, or not on every node."
    )


class PageQuery(StrictModel):
    """Query of a page. Descriptions state the values that a refused one could have had."""

    format: Literal["json"] = Field(default="json", description="json or arrow")
    policy: Literal["latest"] = Field(
        default="latest", description="latest; others need format=arrow"
    )
    node: str | None = None
    """Node whose frames and progress are sent; None: all."""
    rate_hz: float = Field(default=30.0, ge=1.0, le=60.0, description="1 to 60")


class FeedQuery(StrictModel):
    """Query of a program that requests every frame. Descriptions as in `PageQuery`."""

    format: Literal["arrow"]
    policy: Policy = Field(default="lossless", description=", ".join(get_args(Policy)))
    node: str | None = None
    """None: the only one."""
    columns: str = ""
    """Names with commas between; empty: all."""
    stream_id: StreamId | None = Field(default=None, description="32 hex digits")
    from_seq: str | None = Field(
        default=None, pattern=r"^[0-9]{1,15}$", description="a frame's number, from 0"
    )
    """A text: as an integer, `1.0` and `1_000` would be accepted."""


class PageHello(View):
    """First message to a page: state of the server."""

    type: Literal["hello"] = "hello"
    protocol: Literal[1] = 1
    """Version of the live messages."""
    software: str
    t_ns: int
    problems: list[PublicText]
    """Damaged files of the server."""
    nodes: list[NodeView]
    recording: list[SessionView]
    trials: TrialsView


class NodeChanged(View):
    """Present state of a node."""

    type: Literal["node"] = "node"
    node: NodeView


class SessionChanged(View):
    """Present state of a session."""

    type: Literal["session"] = "session"
    session: SessionView


class SessionDeleted(View):
    """Session that was moved to the trash."""

    type: Literal["deleted"] = "deleted"
    session_id: str


class TrialsChanged(View):
    """Present list of trials."""

    type: Literal["trials"] = "trials"
    trials: TrialsView


class SessionsProgress(View):
    """Progress of unsealed sessions, by id."""

    type: Literal["session_progress"] = "session_progress"
    sessions: dict[str, SessionProgress]


class Heartbeat(View):
    """Sign of life, each second."""

    type: Literal["heartbeat"] = "heartbeat"
    t_ns: int
    last_seq: int | None
    nodes: dict[str, NodeCounts]


class FramesDropped(View):
    """Frames of a node that are in no message to this page, ends included."""

    type: Literal["dropped"] = "dropped"
    node: str
    from_seq: int
    to_seq: int


_ByTile = list[float | None]


class FrameMessage(View):
    """Newest frame of a node, with minimum and maximum of all frames since the last message."""

    type: Literal["frame"] = "frame"
    node: str
    seq_first: int
    seq: int
    t_ns: int
    n: int
    frame_flags: int
    tile_flags: list[int]
    estimate_flags: int
    contact: bool | None
    saturated: list[bool]
    servo_age_us: int | None
    angle_rad: float | None
    gauge_kpa: _ByTile
    gauge_min_kpa: _ByTile
    gauge_max_kpa: _ByTile
    force_n: _ByTile
    force_sigma_n: _ByTile
    force_min_n: _ByTile
    force_max_n: _ByTile
    grf_n: float | None
    grf_sigma_n: float | None
    grf_min_n: float | None
    grf_max_n: float | None
    grf_lower_bound_n: float | None
    grf_lower_bound_max_n: float | None
    cop_x_m: float | None
    cop_y_m: float | None
    cop_sigma_x_m: float | None
    cop_sigma_y_m: float | None
    age_ms: float | None


class Ping(View):
    """Only message of a client."""

    type: Literal["ping"]
    t_ms: Annotated[int | float, Field(gt=-(10**18), lt=10**18)]


class Pong(View):
    """Answer to `ping`, with its `t_ms`."""

    type: Literal["pong"] = "pong"
    t_ms: int | float
    t_ns: int


class FeedHello(View):
    """First message to a program."""

    type: Literal["hello"] = "hello"
    protocol: Literal[1] = 1
    software: str
    t_ns: int
    node: str
    policy: Policy


class FeedStream(View):
    """Stream of the following frames; the next binary message is its Arrow schema."""

    type: Literal["stream"] = "stream"
    stream_id: StreamId
    from_seq: int


class FeedGap(View):
    """Frames that a program does not get, ends included: lost, or dropped by its policy."""

    type: Literal["lost", "dropped"]
    stream_id: StreamId
    from_seq: int
    to_seq: int
    reason: str


PageMessage = Annotated[
    PageHello
    | NodeChanged
    | SessionChanged
    | SessionDeleted
    | SessionsProgress
    | TrialsChanged
    | Heartbeat
    | FramesDropped
    | FrameMessage
    | Pong,
    Field(discriminator="type"),
]
FeedMessage = Annotated[FeedHello | FeedStream | FeedGap | Pong, Field(discriminator="type")]
LiveMessage = PageMessage | FeedMessage
PING: TypeAdapter[Ping] = TypeAdapter(Ping)
