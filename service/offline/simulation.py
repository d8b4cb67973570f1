"""Session on emulated chips in virtual time, with the real driver and estimator, into one file.

The output is bit-identical for the same command and version: time is virtual, and all randomness
is seeded.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from devices.acquisition import Acquisition
from devices.array.schedules import ScheduleChoice
from devices.array.startup import prepare_array
from devices.arrays import Columns
from devices.buses.i2c import open_bus
from devices.chips.dynamixel.position_sources import VirtualTimeServoSource
from devices.chips.dynamixel.servo_setup import open_servo
from devices.clock import UtcAnchor, VirtualClock
from devices.emulation.ground.load_trace import TileLoad
from devices.emulation.world import World
from devices.errors import UsageError
from devices.flags import TileFlag
from devices.frames import FrameBatch
from devices.scene.hardware_sections import AnySchedule, ServoSection
from devices.scene.scene_file import Scene
from service.offline.estimate_summary import EstimateSummarizer, EstimateSummary
from service.rig.emulated_foot import EmulatedFoot
from service.rig.rig import make_array_info, open_reference_sensor, open_scene_recovery
from service.sessions.estimate_stream import EstimateOptions, EstimateStream, make_estimate_metadata
from storage.sessions.writer import SealedFileWriter

START_NS = 1_577_836_800_000_000_000
"""Begin of every emulated session, 2020-01-01T00:00:00Z."""

NODE_NAME = "emulated"

_BATCHED_READS = 64

# Real time; long, because a reading lost on a busy machine would change the file.
_SERVO_TIMEOUT_S = 10.0
_SILENT_SERVO_TIMEOUT_S = 0.25
"""Response timeout for an intentionally silent servo, paid for each unanswered request."""


@dataclass(frozen=True)
class SimulationOptions:
    """Options of a simulation; see `foottile simulate --help`."""

    scene: Scene
    seconds: float | None = None
    default_seconds: float | None = None
    """Length of a scene without an end, if `seconds` is not given either."""
    schedule: AnySchedule | None = None
    with_truth: bool = False
    foot: EmulatedFoot = EmulatedFoot()  # noqa: RUF009  # frozen, so one for all is safe


@dataclass(frozen=True)
class SimulationResult:
    """Result of a simulation."""

    frame_count: int
    seconds: float
    rate_hz: float
    missed_slots: int
    schedule_choice: ScheduleChoice
    replaced_serials: tuple[str, ...]
    """Serials of tiles whose chip was replaced."""
    unmeasured_serials: tuple[str, ...]
    """Serials whose conversion time could not be measured; the longest is assumed."""
    flag_counts: Mapping[str, Mapping[str, int]]
    """Frames in which a tile was flagged, by serial and reason."""
    indentation_trace: TileLoad | None
    findings: EstimateSummary
    wall_s: float
    """Real time to acquire, estimate and write the frames, without set-up and calibration."""


class EmulatedRun:
    """Emulated foot, identified over its bus and ready to run."""

    def __init__(self, options: SimulationOptions, stack: ExitStack) -> None:
        scene = options.scene
        self._options = options
        self.pressed = options.foot.compute_tile_load(scene)
        self._clock = VirtualClock()
        self.world = options.foot.make_world(scene, self._clock, self.pressed)
        duration_ns = _compute_duration_ns(options, self.world.ground.duration_s)
        reference = open_reference_sensor(scene, self.world, stack)
        ready = prepare_array(
            open_bus("emulated", self.world.i2c_adapter),
            scene,
            self._clock,
            schedule=options.schedule,
            recovery=open_scene_recovery(scene, self._clock, self.world),
            read_reference_n=None if reference is None else reference.read_force_n,
        )
        self.choice = ready.choice
        self.unmeasured = ready.unmeasured_serials
        self.array = ready.array
        # The machine was switched on earlier; session and scene begin now.
        self.world.begin_scene_time()
        begin_ns = self._clock.now_ns()
        self.end_ns = begin_ns + duration_ns
        """Of the scene, by its own clock."""
        anchor = UtcAnchor.from_readings(begin_ns, START_NS, clock_set=True)
        servo = None
        if scene.servo is not None:
            servo = _make_polled_servo(self.world, scene.servo, begin_ns, stack)
        self.rate_hz = min(scene.rate_hz or ready.predicted_rate_hz, ready.predicted_rate_hz)
        self.info = make_array_info(
            scene,
            ready.tiles,
            anchor,
            node=NODE_NAME,
            stream_id=f"{options.foot.seed:032x}",
            schedule=ready.choice.schedule,
            rate_hz=self.rate_hz,
        )
        self.acquisition = Acquisition(
            ready.array,
            ready.tiles,
            self._clock,
            anchor,
            rate_hz=scene.rate_hz,
            servo=servo,
            lead_end_ns=begin_ns + round(options.foot.lead_s * 1e9),
        )

    def run_frames(self) -> Iterator[tuple[FrameBatch, Columns]]:
        """Yield frames with the emulation's columns: requested truth, and the indenter's notes."""
        indenter = self.world.indenter
        batches = self.acquisition.acquire_batches(lambda: self._clock.now_ns() >= self.end_ns)
        # No live view, so frames are batched; the result is bit-identical for any batch size.
        while gathered := list(islice(batches, _BATCHED_READS)):
            batch = FrameBatch.concatenate(gathered)
            extra: dict[str, npt.NDArray[Any]] = {}
            if self._options.with_truth:
                extra |= asdict(self.world.compute_truth(batch.t_mono_ns))
            if indenter is not None:
                extra |= indenter.get_operator_notes(batch.t_mono_ns)
                # Without a loaded tile, the sensor's reading is no reference.
                idle = np.array([tile is None for tile in extra["pressed_tile"]])
                force_n = np.where(idle, np.float32(np.nan), batch.reference_force_n)
                batch = replace(batch, reference_force_n=force_n)
            yield batch, extra


def run_simulation(
    options: SimulationOptions,
    out_path: Path,
    make_estimate_options: Callable[[], EstimateOptions] | None,
) -> SimulationResult:
    """Run a session and seal it at `out_path`; without `make_estimate_options`, raw frames only.

    `make_estimate_options` is called after the scene has started: a calibration may be slow.

    Raises:
        FootTileError: scene, load or calibration is invalid; `out_path` is unchanged.
    """
    notes: dict[str, object] = {
        "scene": options.scene.model_dump(mode="json"),
        "seed": options.foot.seed,
        "parts_seed": options.foot.parts_seed,
        "lead_s": options.foot.lead_s,
    }
    found = EstimateSummarizer(has_truth=options.with_truth)
    frames = 0
    first_ns = last_ns = 0
    flagged: Counter[tuple[int, str]] = Counter()
    with ExitStack() as stack:
        simulation = EmulatedRun(options, stack)
        pieces: Iterator[tuple[FrameBatch, Columns]] = simulation.run_frames()
        stream = None
        if make_estimate_options is not None:
            stream = EstimateStream(simulation.info, make_estimate_options())
            pieces = iter(stream.estimate_batches(pieces))
        writer = stack.enter_context(SealedFileWriter(out_path, simulation.info, notes))
        began_s = time.perf_counter()
        for batch, extra in pieces:
            if stream is not None and stream.plan is not None and not frames:
                writer.add_notes_before_first_row_group(
                    make_estimate_metadata(stream.plan, stream.rounding)
                )
            writer.append_frames(batch, extra)
            first_ns = first_ns or int(batch.t_ns[0])
            last_ns = int(batch.t_ns[-1])
            frames += len(batch)
            flagged.update(_count_flags(batch))
            if stream is not None:
                found.add_frames(batch, extra)
    seconds = (last_ns - first_ns) * 1e-9
    options.foot.write_plate_recordings(simulation.world, simulation.end_ns)
    return SimulationResult(
        frame_count=frames,
        seconds=seconds,
        rate_hz=(frames - 1) / seconds if seconds else float("nan"),
        missed_slots=simulation.acquisition.missed_slots,
        schedule_choice=simulation.choice,
        replaced_serials=simulation.array.replaced_serials,
        unmeasured_serials=simulation.unmeasured,
        flag_counts={
            serial: {reason: n for (i, reason), n in sorted(flagged.items()) if i == tile}
            for tile, serial in enumerate(simulation.info.serials)
            if any(i == tile for i, _ in flagged)
        },
        indentation_trace=simulation.pressed,
        findings=found.finish_summary(stream.plan) if stream and stream.plan else EstimateSummary(),
        wall_s=time.perf_counter() - began_s,
    )


def _count_flags(batch: FrameBatch) -> dict[tuple[int, str], int]:
    """Count the frames of a batch with a tile flag, by tile index and flag name."""
    if not batch.tile_flags.any():
        return {}
    counts = {}
    for bit in TileFlag:
        for tile, n in enumerate(((batch.tile_flags & np.uint8(bit)) != 0).sum(axis=0).tolist()):
            if n and bit.name:
                counts[tile, bit.name.lower()] = n
    return counts


def _compute_duration_ns(options: SimulationOptions, ground_s: float | None) -> int:
    lengths_s = (options.seconds, ground_s, options.default_seconds)
    seconds = next((s for s in lengths_s if s is not None), None)
    if seconds is None:
        raise UsageError(
            f"scene {options.scene.name!r} has no end of its own", remedy="Add --seconds S"
        )
    return round(seconds * 1e9)


def _make_polled_servo(
    world: World, scene: ServoSection, now_ns: int, stack: ExitStack
) -> VirtualTimeServoSource:
    line_clock = VirtualClock(now_ns)
    emulated = stack.enter_context(world.open_servo(scene, line_clock))
    may_be_silent = any(fault.kind == "servo_restart" for fault in world.scene.fault)
    servo = open_servo(
        lambda: emulated.port,
        baudrate=scene.baudrate,
        clock=line_clock,
        servo_id=scene.id,
        model=scene.model,
        protocol=scene.protocol,
        port_timeout_s=_SILENT_SERVO_TIMEOUT_S if may_be_silent else _SERVO_TIMEOUT_S,
    )
    stack.callback(servo.close)
    return VirtualTimeServoSource(servo, line_clock, rate_hz=scene.rate_hz)
