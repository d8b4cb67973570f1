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
from devices.array.budget import Choice
from devices.array.startup import make_ready
from devices.buses.i2c import open_bus
from devices.chips.dynamixel.reader import open_servo
from devices.chips.dynamixel.servo import PolledServo
from devices.clock import UtcAnchor, VirtualClock
from devices.emulation.ground.load_trace import PressedTrace
from devices.emulation.world import World
from devices.errors import UsageError
from devices.frames import FrameBatch, TileStatus
from devices.scene.file import Scene
from devices.scene.hardware import AnySchedule, ServoScene
from service.offline.findings import Findings, FindingsOf
from service.rig.description import describe
from service.rig.emulated import EmulatedFoot
from service.rig.rig import open_recovery_lines, open_reference_sensor
from service.sessions.pipeline import EstimateOptions, EstimateStream, Extra, notes_of
from storage.sessions.file import SessionWriter

START_NS = 1_577_836_800_000_000_000
"""Begin of every emulated session, 2020-01-01T00:00:00Z."""

NODE = "emulated"

_GATHER = 64

# Real time; long, because a reading lost on a busy machine would change the file.
_ANSWER_S = 10.0
_SILENCE_S = 0.25
"""Response timeout for an intentionally silent servo, paid for each unanswered request."""


@dataclass(frozen=True)
class SimulateOptions:
    """Options of a simulation; see `foottile simulate --help`."""

    scene: Scene
    seconds: float | None = None
    otherwise_s: float | None = None
    """Length of a scene without an end, if `seconds` is not given either."""
    schedule: AnySchedule | None = None
    truth: bool = False
    foot: EmulatedFoot = EmulatedFoot()  # noqa: RUF009  # frozen, so one for all is safe


@dataclass(frozen=True)
class Simulated:
    """Result of a simulation."""

    frames: int
    seconds: float
    rate_hz: float
    missed_slots: int
    choice: Choice
    replaced: tuple[str, ...]
    """Serials of tiles whose chip was replaced."""
    unmeasured: tuple[str, ...]
    """Serials whose conversion time could not be measured; 3 ms are assumed."""
    flags: Mapping[str, Mapping[str, int]]
    """Frames in which a tile was flagged, by serial and reason."""
    pressed: PressedTrace | None
    findings: Findings
    wall_s: float
    """Real time to acquire, estimate and write the frames, without set-up and calibration."""


class Simulation:
    """Emulated foot, identified over its bus and ready to run."""

    def __init__(self, options: SimulateOptions, stack: ExitStack) -> None:
        scene = options.scene
        self._options = options
        self.pressed = options.foot.pressed_on(scene)
        self._clock = VirtualClock()
        self.world = options.foot.world(scene, self._clock, self.pressed)
        duration_ns = _duration_ns(options, self.world.ground.duration_s)
        reference = open_reference_sensor(scene, self.world, stack)
        ready = make_ready(
            open_bus("emulated", self.world.i2c_adapter),
            scene,
            self._clock,
            schedule=options.schedule,
            recovery=open_recovery_lines(scene, self._clock, self.world),
            reference_n=None if reference is None else reference.read_n,
        )
        self.choice = ready.choice
        self.unmeasured = ready.unmeasured
        self.array = ready.array
        # The machine was switched on earlier; session and scene begin now.
        self.world.begin()
        begin_ns = self._clock.now_ns()
        self.end_ns = begin_ns + duration_ns
        """Of the scene, by its own clock."""
        anchor = UtcAnchor.of(begin_ns, START_NS, clock_set=True)
        servo = None
        if scene.servo is not None:
            servo = _polled_servo(self.world, scene.servo, begin_ns, stack)
        self.rate_hz = min(scene.rate_hz or ready.predicted_hz, ready.predicted_hz)
        self.info = describe(
            scene,
            ready.tiles,
            anchor,
            node=NODE,
            boot_id=f"{options.foot.seed:032x}",
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

    def pieces(self) -> Iterator[tuple[FrameBatch, Extra]]:
        """Yield frames with the emulation's columns: requested truth, and the indenter's notes."""
        mill = self.world.mill
        batches = self.acquisition.run(lambda: self._clock.now_ns() >= self.end_ns)
        # No live view, so frames are batched; the result is bit-identical for any batch size.
        while gathered := list(islice(batches, _GATHER)):
            batch = FrameBatch.concatenate(gathered)
            extra: dict[str, npt.NDArray[Any]] = {}
            if self._options.truth:
                extra |= asdict(self.world.truth(batch.t_mono_ns))
            if mill is not None:
                extra |= mill.notes(batch.t_mono_ns)
                # Without a loaded tile, the sensor's reading is no reference.
                idle = np.array([tile is None for tile in extra["pressed_tile"]])
                force_n = np.where(idle, np.float32(np.nan), batch.reference_force_n)
                batch = replace(batch, reference_force_n=force_n)
            yield batch, extra


def simulate(
    options: SimulateOptions, out: Path, estimate: Callable[[], EstimateOptions] | None
) -> Simulated:
    """Run a session and seal it at `out`; without `estimate`, raw frames only.

    `estimate` is called after the scene has started: a calibration may be slow.

    Raises:
        FootTileError: scene, load or calibration is invalid; `out` is unchanged.
    """
    notes: dict[str, object] = {
        "scene": options.scene.model_dump(mode="json"),
        "seed": options.foot.seed,
        "parts_seed": options.foot.parts_seed,
        "lead_s": options.foot.lead_s,
    }
    found = FindingsOf(judging=options.truth)
    frames = 0
    first_ns = last_ns = 0
    flagged: Counter[tuple[int, str]] = Counter()
    with ExitStack() as stack:
        simulation = Simulation(options, stack)
        pieces: Iterator[tuple[FrameBatch, Extra]] = simulation.pieces()
        stream = None
        if estimate is not None:
            stream = EstimateStream(simulation.info, estimate())
            pieces = iter(stream.run(pieces))
        writer = stack.enter_context(SessionWriter(out, simulation.info, notes))
        began_s = time.perf_counter()
        for batch, extra in pieces:
            if stream is not None and stream.plan is not None and not frames:
                writer.add_notes(notes_of(stream.plan, stream.rounding))
            writer.append(batch, extra)
            first_ns = first_ns or int(batch.t_ns[0])
            last_ns = int(batch.t_ns[-1])
            frames += len(batch)
            flagged.update(_flags(batch))
            if stream is not None:
                found.feed(batch, extra)
    seconds = (last_ns - first_ns) * 1e-9
    options.foot.write_plates(simulation.world, simulation.end_ns)
    return Simulated(
        frames=frames,
        seconds=seconds,
        rate_hz=(frames - 1) / seconds if seconds else float("nan"),
        missed_slots=simulation.acquisition.missed_slots,
        choice=simulation.choice,
        replaced=simulation.array.replaced,
        unmeasured=simulation.unmeasured,
        flags={
            serial: {reason: n for (i, reason), n in sorted(flagged.items()) if i == tile}
            for tile, serial in enumerate(simulation.info.serials)
            if any(i == tile for i, _ in flagged)
        },
        pressed=simulation.pressed,
        findings=found.finish(stream.plan) if stream and stream.plan else Findings(),
        wall_s=time.perf_counter() - began_s,
    )


def _flags(batch: FrameBatch) -> dict[tuple[int, str], int]:
    """Count the frames of a batch with a tile flag, by tile index and flag name."""
    if not batch.status.any():
        return {}
    counts = {}
    for bit in TileStatus:
        for tile, n in enumerate(((batch.status & np.uint8(bit)) != 0).sum(axis=0).tolist()):
            if n and bit.name:
                counts[tile, bit.name.lower()] = n
    return counts


def _duration_ns(options: SimulateOptions, ground_s: float | None) -> int:
    lengths_s = (options.seconds, ground_s, options.otherwise_s)
    seconds = next((s for s in lengths_s if s is not None), None)
    if seconds is None:
        raise UsageError(
            f"scene {options.scene.name!r} has no end of its own", remedy="Add --seconds S"
        )
    return round(seconds * 1e9)


def _polled_servo(world: World, scene: ServoScene, now_ns: int, stack: ExitStack) -> PolledServo:
    line_clock = VirtualClock(now_ns)
    emulated = stack.enter_context(world.servo(scene, line_clock))
    may_be_silent = any(fault.kind == "servo_restart" for fault in world.scene.fault)
    servo = open_servo(
        lambda: emulated.port,
        baudrate=scene.baudrate,
        clock=line_clock,
        servo_id=scene.id,
        model=scene.model,
        protocol=scene.protocol,
        patience_s=_SILENCE_S if may_be_silent else _ANSWER_S,
    )
    stack.callback(servo.close)
    return PolledServo(servo, line_clock, rate_hz=scene.rate_hz)
