"""JSON shapes of nodes, tares and sessions in the API, with their descriptions."""

from __future__ import annotations

import math
from typing import Generic, Literal, TypeVar

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field

from devices.frames import ArrayInfo, ServoInfo
from service.estimation.calibration import Calibration
from service.estimation.compilation import is_compiling
from service.estimation.tare.tare import (
    IntervalSource,
    compute_sealed_gas_shift_kpa,
    compute_warming_k,
    fit_recent_baseline_trend,
)
from service.server.estimates.live_estimator import TileRanges
from service.server.estimates.tare_controller import AutoTareState
from service.server.identities import RefusedMachine
from service.server.node import ServerNode
from service.server.recorder import Recorder
from service.server.session_store import marker_revision, user_fields_revision
from service.sessions.tares import RecordedTare
from service.user_folders import PublicText
from storage.sessions.folder import Marker, Part, Session

T = TypeVar("T")
CalibrationSource = Literal["node", "server"]


class View(BaseModel):
    """Base of all answers; unknown values are null, never NaN."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)


class Page(View, Generic[T]):
    """Page of a list."""

    items: list[T]
    next_cursor: str | None = Field(
        default=None, description="Value of `?cursor=` for the next page; null: this is the last."
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

    @classmethod
    def from_calibration(
        cls, calibration: Calibration, calibration_id: str, *, is_scale_assumed: bool
    ) -> CalibrationView:
        """Return the view of a calibration."""
        return cls(
            id=calibration_id,
            name=calibration.name,
            absolute_scale="assumed" if is_scale_assumed else "measured",
        )


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

    @classmethod
    def from_recorded(cls, recorded: RecordedTare) -> TareView:
        """Return the view of a tare of the history."""
        content = recorded.tare.as_dict()
        return cls(
            id=recorded.id,
            undone=recorded.undone,
            reason=recorded.reason,
            **{name: content[name] for name in cls.model_fields if name in content},
        )


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

    @classmethod
    def from_node(cls, node: ServerNode) -> DriftView:
        """Return the present drift of a node."""
        live, tiles = node.estimator.live, len(node.last_info.tiles)
        line = fit_recent_baseline_trend(
            node.estimator.tare_history.valid_tares(node.last_info), tiles=tiles
        )
        unknown = np.full(tiles, np.nan)
        slope = unknown if live.ranges is None else live.ranges.slope_n_per_kpa
        warmer_by_k = (
            unknown
            if live.tare_in_use_unless_lost is None
            else compute_warming_k(live.tare_in_use_unless_lost, live.mean_recent_temperature_raw())
        )
        since_kpa = (
            unknown
            if live.tare_in_use_unless_lost is None
            else compute_sealed_gas_shift_kpa(live.tare_in_use_unless_lost, warmer_by_k)
        )
        # A bare tile has no sealed gas.
        since_kpa = np.where([tile.reference for tile in node.last_info.tiles], np.nan, since_kpa)
        return cls(
            kpa_per_hour=_nan_to_none(line.kpa_per_hour),
            sigma_kpa_per_hour=_nan_to_none(line.sigma_kpa_per_hour),
            n_per_hour=_nan_to_none(line.kpa_per_hour * slope),
            grf_n_per_hour=live.grf_shift_n(line.kpa_per_hour),
            kelvin_per_hour=_nan_to_none(line.kelvin_per_hour),
            kelvin_since_tare=_nan_to_none(warmer_by_k),
            kpa_since_tare=_nan_to_none(since_kpa),
            grf_n_since_tare=live.grf_shift_n(since_kpa),
        )


class TaresPage(Page[TareView]):
    """History of a node's tares, and the drift of its baselines."""

    drift: DriftView


class ClockView(View):
    """Offset of the clocks, from the best of eight probes."""

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

    @classmethod
    def from_replacement(cls, replacement: RefusedMachine) -> ReplacementView:
        """Return the view, without the secret."""
        return cls(**{name: getattr(replacement, name) for name in cls.model_fields})


class NodeView(View):
    """Node, connected or remembered."""

    node: str = Field(examples=["demo"])
    connected: bool
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
    rate_hz: float | None = Field(description="Frames per second over the last second.")
    lost_frames: int = Field(description="Lost frames of this stream.")
    lost: dict[str, int] = Field(description="The same by reason.", examples=[{"evicted": 12}])
    backlog_frames: int = Field(
        description="Frames of this stream that the node still has, sent behind the newest."
    )
    missed_slots: int = Field(description="Slots that were not sampled in its present stream.")
    warnings: list[str] = Field(description="Present faults of its array or disk, as text.")
    compiling: bool = Field(
        description="Models are being compiled, once on this machine: frames have pressures only."
    )
    fault_counts: dict[str, dict[str, int]] = Field(
        description="Faults of this stream, counted by serial and reason."
    )
    last_seq: int | None
    last_t_ns: int | None
    last_seen_t_ns: int | None = Field(description="Arrival time of its last frame, server's UTC.")
    recording: list[str] = Field(description="Ids of sessions that are being recorded.")
    replacement: ReplacementView | None = Field(
        description="Machine that was refused because another one has this name. A person may "
        "accept it with `accept-replacement`."
    )

    @classmethod
    def from_node(
        cls, node: ServerNode, recorder: Recorder, replacement: RefusedMachine | None
    ) -> NodeView:
        """Return the present state of a node."""
        info, estimates = node.last_info, node.estimator
        live, keeper = estimates.live, estimates.tare_controller
        calibration = live.calibration
        tare, lost = (
            estimates.tare_history.tare_in_force_unless_lost(info),
            node.present_stream_lost_by_reason,
        )
        return cls(
            node=node.name,
            connected=node.is_connected,
            stream_id=node.stream_id,
            scene=info.scene,
            emulated=node.hello.emulated,
            tiles=make_tile_views(info, live.ranges),
            servo=info.servo,
            schedule=info.schedule,
            nominal_rate_hz=info.nominal_rate_hz,
            calibration=None
            if calibration is None or live.calibration_id is None or live.ranges is None
            else CalibrationView.from_calibration(
                calibration, live.calibration_id, is_scale_assumed=live.ranges.is_scale_assumed
            ),
            calibration_source=estimates.calibration_source,
            calibration_problem=estimates.calibration_problem,
            tare=TareView.from_recorded(tare) if tare is not None else None,
            tare_problem=keeper.missing_tare_reason,
            tare_warnings=keeper.list_reasons_to_tare_again(),
            auto_tare=keeper.auto_tare_state,
            drift=DriftView.from_node(node),
            storage_problem=node.storage_problem,
            clock=None
            if node.clock_offset is None
            else ClockView(
                server_minus_node_ns=node.clock_offset.server_minus_node_ns,
                uncertainty_ns=node.clock_offset.uncertainty_ns,
            ),
            clock_set=info.clock_set,
            rate_hz=node.rate_hz if node.is_connected else None,
            lost_frames=sum(lost.values()),
            lost=lost,
            backlog_frames=node.present_stream_backlog_frames,
            missed_slots=node.present_stream.missed_slots,
            warnings=[*node.warnings, *node.refused_ahead_frames_warnings],
            compiling=is_compiling(),
            fault_counts=node.fault_counts,
            last_seq=node.last_seq,
            last_t_ns=node.last_t_ns,
            last_seen_t_ns=node.last_seen_t_ns,
            recording=[session.id for session in recorder.list_recording(node.name)],
            replacement=None
            if replacement is None
            else ReplacementView.from_replacement(replacement),
        )


class SessionView(View):
    """Recorded session."""

    id: str = Field(examples=["20261121T101500Z-1a2b3c"])
    name: str
    node: str
    state: Literal["recording", "pending", "sealing", "sealed"] = Field(
        description="pending: waits for the node (`pending_reason`), and completes by itself."
    )
    complete: bool | Literal["lossy"] = Field(
        description="true: it has every frame; 'lossy': some frames are lost."
    )
    started_t_ns: int = Field(description="Server's UTC.")
    stopped_t_ns: int | None
    duration_s: float
    frames: int
    pending_frames: int = Field(description="Still with the node.")
    pending_reason: Literal["frames", "end"] | None = Field(
        description="frames: `pending_frames` are still with the node; end: the last frames "
        "before the stop have not come; null: not pending."
    )
    lost: dict[str, int] = Field(description="Lost frames, by reason.", examples=[{"evicted": 12}])
    max_lost_tail_frames: int = Field(
        description="Upper bound of lost frames at an unknown end: the node lost power, or its "
        "frames were abandoned."
    )
    missed_slots: int = Field(
        description="Slots that the node did not sample because it was late: no frame exists."
    )
    marker_count: int = Field(description="Number of its markers.")
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

    @classmethod
    def from_session(cls, session: Session, recorder: Recorder) -> SessionView:
        """Return the present state of a session."""
        ledger = recorder.compute_ledger(session)
        made = {"frames", "pending_frames", "lost", "max_lost_tail_frames", "duration_s", "problem"}
        made |= {"marker_count", "missed_slots", "pending_reason", "revision"}
        content = session.model_dump(include=set(cls.model_fields) - made)
        return cls(
            **content | {"complete": ledger.completeness},
            frames=ledger.recorded,
            pending_frames=ledger.pending,
            pending_reason=recorder.pending_reason(session, ledger),
            lost=ledger.lost,
            missed_slots=ledger.missed_slots,
            marker_count=len(session.markers),
            revision=user_fields_revision(session),
            max_lost_tail_frames=ledger.max_lost_tail_frames,
            problem=recorder.find_problem_to_show(session),
            duration_s=recorder.compute_duration_s(session, ledger.recorded),
        )


class SessionProgress(View):
    """Progress of an unsealed session; the fields are those of `SessionView`."""

    frames: int
    pending_frames: int
    pending_reason: Literal["frames", "end"] | None
    lost: dict[str, int]
    missed_slots: int
    duration_s: float

    @classmethod
    def from_session(cls, session: Session, recorder: Recorder) -> SessionProgress:
        """Return the present progress, from the ledger."""
        ledger = recorder.compute_ledger(session)
        return cls(
            frames=ledger.recorded,
            pending_frames=ledger.pending,
            pending_reason=recorder.pending_reason(session, ledger),
            lost=ledger.lost,
            missed_slots=ledger.missed_slots,
            duration_s=round(recorder.compute_duration_s(session, ledger.recorded), 1),
        )


class MarkerView(View):
    """Marker of a session."""

    id: str
    label: str
    t_ns: int = Field(description="Server's UTC.")
    revision: str = Field(description="Its revision, for `If-Match`.")

    @classmethod
    def from_marker(cls, marker: Marker) -> MarkerView:
        """Return the view of a marker."""
        return cls(**marker.model_dump(), revision=marker_revision(marker))


def make_tile_views(info: ArrayInfo, ranges: TileRanges | None) -> list[TileView]:
    """Return the tiles of an array; without a calibration their ranges are null."""
    nones = [None] * len(info.tiles)
    full_scales = nones if ranges is None else _nan_to_none(ranges.full_scale_n)
    entries = nones if ranges is None else ranges.entries
    placed = {"serial", "mux", "channel", "x_m", "y_m", "z_m", "reference"}
    return [
        TileView(
            range_kpa=entry.range_kpa if entry is not None else None,
            full_scale_n=full_scale_n,
            **tile.model_dump(include=placed),
        )
        for tile, entry, full_scale_n in zip(info.tiles, entries, full_scales, strict=True)
    ]


def _nan_to_none(values: npt.NDArray[np.float64]) -> list[float | None]:
    return [value if math.isfinite(value) else None for value in values.tolist()]
