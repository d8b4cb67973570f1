"""What the API says of nodes, tares and sessions: the JSON shapes, with their descriptions."""

from __future__ import annotations

import math
from typing import Generic, Literal, TypeVar

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field

from devices.frames import ArrayInfo, ServoInfo
from service.estimation.tare.tare import TakenFrom, expected_shift_kpa, trend, warmer_k
from service.estimation.warm import WARMING, is_warming
from service.private_paths import ShownText
from service.server.book import mark_of, said_of
from service.server.estimates.ranges import Ranges
from service.server.estimates.tare_keeper import AutoTare
from service.server.identities import Replacement
from service.server.node import ServerNode
from service.server.recorder import Recorder
from service.sessions.tare_file import RecordedTare
from storage.sessions.folder import Event, Part, Session

T = TypeVar("T")
CalibrationSource = Literal["node", "server"]


class View(BaseModel):
    """Base of all answers; what is not known is null, and never a NaN that JSON cannot write."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)


class Page(View, Generic[T]):
    """A part of a list."""

    items: list[T]
    next_cursor: str | None = Field(
        default=None, description="Ask again with `?cursor=` this for more; null: that was all."
    )


class TileView(View):
    """One tile of an array."""

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
    """Which calibration is in use."""

    id: str
    name: str
    absolute_scale: Literal["measured", "assumed"]


class TareView(View):
    """One tare."""

    id: str
    t_ns: int = Field(description="End of the interval it was taken from, node's UTC.")
    source: TakenFrom = Field(
        description="unloaded: by hand; flight: automatic; lead: of an emulation."
    )
    reason: str = Field(description="Why, in words.")
    frames: int = Field(description="How many frames it was taken from.")
    baseline_kpa: list[float] = Field(description="Absolute pressure unloaded, by tile.")
    baseline_sigma_kpa: list[float] = Field(description="Its standard uncertainty.")
    noise_kpa: list[float] = Field(description="Standard deviation of one reading.")
    tadc_counts: list[float | None] = Field(
        description="Mean temperature counts, by tile; null in tares of older versions."
    )
    undone: bool

    @classmethod
    def of(cls, recorded: RecordedTare) -> TareView:
        """From the history."""
        content = recorded.tare.as_dict()
        return cls(
            id=recorded.id,
            undone=recorded.undone,
            reason=recorded.reason,
            **{name: content[name] for name in cls.model_fields if name in content},
        )


class DriftView(View):
    """How baselines move. Lists are by tile; null is what is not determined."""

    kpa_per_hour: list[float | None] = Field(
        description="Straight line through the baselines of the last six hours; null until they "
        "span ten minutes."
    )
    sigma_kpa_per_hour: list[float | None] = Field(description="Its standard uncertainty.")
    n_per_hour: list[float | None] = Field(
        description="The same in newtons, near zero load; null without a calibration."
    )
    grf_n_per_hour: float | None = Field(description="Sum over the tiles that bear load.")
    kelvin_per_hour: list[float | None] = Field(
        description="Of the chips, by the temperatures of the same tares."
    )
    kelvin_since_tare: list[float | None] = Field(
        description="How much warmer the chips are now than at the tare, by `tadc`."
    )
    kpa_since_tare: list[float | None] = Field(
        description="What a sealed bubble's baseline has moved by then, as far as that explains it."
    )
    grf_n_since_tare: float | None = Field(description="What that makes of the GRF.")

    @classmethod
    def of(cls, node: ServerNode) -> DriftView:
        """Of a node as it is now."""
        live, tiles = node.estimates.live, len(node.info.tiles)
        line = trend(node.estimates.tares.valid(node.info), tiles=tiles)
        none = np.full(tiles, np.nan)
        slope = none if live.ranges is None else live.ranges.slope_n_per_kpa
        warmer_by_k = none if live.tare is None else warmer_k(live.tare, live.recent_tadc())
        since_kpa = none if live.tare is None else expected_shift_kpa(live.tare, warmer_by_k)
        # A bare tile has no sealed gas.
        since_kpa = np.where([tile.reference for tile in node.info.tiles], np.nan, since_kpa)
        return cls(
            kpa_per_hour=_known(line.kpa_per_hour),
            sigma_kpa_per_hour=_known(line.sigma_kpa_per_hour),
            n_per_hour=_known(line.kpa_per_hour * slope),
            grf_n_per_hour=live.newtons(line.kpa_per_hour),
            kelvin_per_hour=_known(line.kelvin_per_hour),
            kelvin_since_tare=_known(warmer_by_k),
            kpa_since_tare=_known(since_kpa),
            grf_n_since_tare=live.newtons(since_kpa),
        )


class TaresPage(Page[TareView]):
    """The history of a node's tares, and where its baselines are going."""

    drift: DriftView


class ClockView(View):
    """Offset of the clocks, measured by the best of eight probes."""

    server_minus_node_ns: int
    uncertainty_ns: int = Field(description="Half the round trip of that probe.")


class ReplacementView(View):
    """A machine that asked to connect under the name of this node, and was refused."""

    fingerprint: str = Field(
        description="The machine prints the same one.", examples=["3f2a-91bc-0d4e-77a1"]
    )
    address: str = Field(description="Where it connected from; behind a proxy the proxy's.")
    asked_t_ns: int = Field(description="Server's UTC.")

    @classmethod
    def of(cls, replacement: Replacement) -> ReplacementView:
        """Return it without its secret."""
        return cls(**{name: getattr(replacement, name) for name in cls.model_fields})


class NodeView(View):
    """One node, connected or remembered."""

    node: str = Field(examples=["demo"])
    connected: bool
    boot_id: str = Field(description="Name of its present stream; a new one at each start.")
    scene: str
    emulated: bool
    tiles: list[TileView]
    servo: ServoInfo | None
    schedule: str
    nominal_rate_hz: float
    calibration: CalibrationView | None
    calibration_source: CalibrationSource = Field(
        description="Who says which: the node itself, or the server, where one was assigned."
    )
    calibration_problem: ShownText | None = Field(description="Why there is no calibration.")
    tare: TareView | None = Field(description="The tare in force.")
    tare_problem: ShownText | None = Field(
        description="Why there is none, or why the one in force is not this stream's own."
    )
    tare_warnings: list[str] = Field(
        description="Why the tare in force may no longer fit, in words: old, another temperature, "
        "a baseline that does not fit the foot in the air."
    )
    auto_tare: AutoTare = Field(
        description="Whether the baseline follows by itself in flight. paused: an automatic tare "
        "was undone, and nobody has tared since; off: the scene says `auto_tare = false`."
    )
    drift: DriftView
    storage_problem: ShownText | None = Field(description="Why frames are not being kept.")
    clock: ClockView | None = Field(description="Null: not measured yet.")
    clock_set: bool = Field(description="Whether anything had set the node's date.")
    rate_hz: float | None = Field(description="Frames a second over the last second.")
    lost_frames: int = Field(description="Frames of this stream that are missing for good.")
    lost: dict[str, int] = Field(description="The same by reason.", examples=[{"evicted": 12}])
    backlog_frames: int = Field(
        description="Frames of this stream that the node still has, and sends behind the newest."
    )
    missed_slots: int = Field(description="Slots that were not sampled in its present stream.")
    troubles: list[str] = Field(
        description="What is wrong with its array, or its disk, now, in words."
    )
    fault_counts: dict[str, dict[str, int]] = Field(
        description="How often what went wrong in this stream, by serial and reason."
    )
    last_seq: int | None
    last_t_ns: int | None
    last_seen_t_ns: int | None = Field(description="When its last frame came, server's UTC.")
    recording: list[str] = Field(description="Ids of sessions that are being recorded.")
    replacement: ReplacementView | None = Field(
        description="Another machine that asks to connect under this name. A person accepts it "
        "with `accept-replacement`, or leaves it refused."
    )

    @classmethod
    def of(cls, node: ServerNode, recorder: Recorder, replacement: Replacement | None) -> NodeView:
        """Of a node as it is now."""
        info, estimates = node.info, node.estimates
        live, keeper = estimates.live, estimates.tare_keeper
        calibration = live.calibration
        tare, lost = estimates.tares.in_force(info), node.lost
        return cls(
            node=node.name,
            connected=node.connected,
            boot_id=node.boot_id,
            scene=info.scene,
            emulated=node.hello.emulated,
            tiles=tiles_of(info, live.ranges),
            servo=info.servo,
            schedule=info.schedule,
            nominal_rate_hz=info.nominal_rate_hz,
            calibration=None
            if calibration is None or live.calibration_id is None or live.ranges is None
            else CalibrationView(
                id=live.calibration_id, name=calibration.name, absolute_scale=scale_of(live.ranges)
            ),
            calibration_source=estimates.calibration_source,
            calibration_problem=estimates.calibration_problem,
            tare=TareView.of(tare) if tare is not None else None,
            tare_problem=keeper.problem,
            tare_warnings=keeper.warnings(),
            auto_tare=keeper.auto_tare,
            drift=DriftView.of(node),
            storage_problem=node.storage_problem,
            clock=None
            if node.clock is None
            else ClockView(
                server_minus_node_ns=node.clock.server_minus_node_ns,
                uncertainty_ns=node.clock.uncertainty_ns,
            ),
            clock_set=info.clock_set,
            rate_hz=node.rate_hz if node.connected else None,
            lost_frames=sum(lost.values()),
            lost=lost,
            backlog_frames=node.backlog_frames,
            missed_slots=node.present.missed_slots,
            troubles=[
                *node.troubles,
                *node.refusals,
                *([WARMING] if is_warming() else []),
            ],
            fault_counts=node.fault_counts,
            last_seq=node.last_seq,
            last_t_ns=node.last_t_ns,
            last_seen_t_ns=node.last_seen_t_ns,
            recording=[session.id for session in recorder.recording_on(node.name)],
            replacement=None if replacement is None else ReplacementView.of(replacement),
        )


class SessionView(View):
    """One recorded session."""

    id: str = Field(examples=["20261121T101500Z-1a2b3c"])
    name: str
    node: str
    state: Literal["recording", "pending", "sealing", "sealed"] = Field(
        description="pending: what `waits_for` says is still with the node; it completes by itself."
    )
    complete: bool | Literal["lossy"] = Field(
        description="true: every frame is in it; 'lossy': some never will be."
    )
    started_t_ns: int = Field(description="Server's UTC.")
    stopped_t_ns: int | None
    duration_s: float
    frames: int
    pending_frames: int = Field(description="Still with the node.")
    waits_for: Literal["frames", "end"] | None = Field(
        description="frames: `pending_frames` are still with the node; end: none is missing up "
        "to the newest, but what the node took last, until the stop, has not come; null: nothing."
    )
    lost: dict[str, int] = Field(
        description="Frames that will never be in it, by reason.", examples=[{"evicted": 12}]
    )
    tail_frames_max: int = Field(
        description="How many more there may have been at an end that the node could not tell: its "
        "power failed, or it was given up."
    )
    missed_slots: int = Field(
        description="Slots that the node did not sample, since it was late: no frame was there."
    )
    marks: int = Field(description="Events that were marked in it.")
    bytes: int | None = Field(description="Size of the sealed file.")
    sha256: str | None = Field(description="Hash of the sealed file.")
    parts: list[Part] = Field(description="Intervals of streams, ends included.")
    subject: str
    notes: str
    tags: list[str]
    take: str | None = Field(
        description="The take in which it was recorded together with other nodes."
    )
    scene: str
    calibration_id: str | None
    calibration_source: CalibrationSource = Field(
        description="Who said which calibration: the node, or the server, where one was assigned."
    )
    absolute_scale: Literal["measured", "assumed"] | None
    problem: ShownText | None = Field(description="What a person should know of it.")
    said: str = Field(
        description="Hash of name, subject, notes and tags; as `If-Match` it has a change refused "
        "(412) if somebody else was quicker."
    )

    @classmethod
    def of(cls, session: Session, recorder: Recorder) -> SessionView:
        """Of a session as it is now."""
        ledger = recorder.ledger_of(session)
        made = {"frames", "pending_frames", "lost", "tail_frames_max", "duration_s", "problem"}
        made |= {"marks", "missed_slots", "waits_for", "said"}
        content = session.model_dump(include=set(cls.model_fields) - made)
        return cls(
            **content | {"complete": ledger.completeness},
            frames=ledger.recorded,
            pending_frames=ledger.pending,
            waits_for=recorder.waits_for(session, ledger),
            lost=ledger.lost,
            missed_slots=ledger.missed_slots,
            marks=len(session.events),
            said=said_of(session),
            tail_frames_max=ledger.unsynced_tail_max,
            problem=recorder.problem_of(session),
            duration_s=recorder.duration_s(session, ledger.recorded),
        )


class Counted(View):
    """How far a session has come that is not sealed yet; the fields are those of `SessionView`."""

    frames: int
    pending_frames: int
    waits_for: Literal["frames", "end"] | None
    lost: dict[str, int]
    duration_s: float

    @classmethod
    def of(cls, session: Session, recorder: Recorder) -> Counted:
        """By the ledger, as of now."""
        ledger = recorder.ledger_of(session)
        return cls(
            frames=ledger.recorded,
            pending_frames=ledger.pending,
            waits_for=recorder.waits_for(session, ledger),
            lost=ledger.lost,
            duration_s=round(recorder.duration_s(session, ledger.recorded), 1),
        )


class EventView(View):
    """Something that was marked in a session."""

    id: str
    label: str
    t_ns: int = Field(description="Server's UTC.")
    said: str = Field(description="Its hash, as that of a session: for `If-Match`.")

    @classmethod
    def of(cls, event: Event) -> EventView:
        """As it is now."""
        return cls(**event.model_dump(), said=mark_of(event))


def tiles_of(info: ArrayInfo, ranges: Ranges | None) -> list[TileView]:
    """Tiles of an array; without a calibration their ranges are not known."""
    none = [None] * len(info.tiles)
    full_scales = none if ranges is None else _known(ranges.full_scale_n)
    entries = none if ranges is None else ranges.entries
    placed = {"serial", "mux", "channel", "x_m", "y_m", "z_m", "reference"}
    return [
        TileView(
            range_kpa=entry.range_kpa if entry is not None else None,
            full_scale_n=full_scale_n,
            **tile.model_dump(include=placed),
        )
        for tile, entry, full_scale_n in zip(info.tiles, entries, full_scales, strict=True)
    ]


def _known(values: npt.NDArray[np.float64]) -> list[float | None]:
    return [value if math.isfinite(value) else None for value in values.tolist()]


def scale_of(ranges: Ranges) -> Literal["measured", "assumed"]:
    """Are newtons of these tiles measured, or is the scale of one of them assumed?"""
    assumed = any(e is not None and e.absolute_scale == "assumed" for e in ranges.entries)
    return "assumed" if assumed else "measured"
