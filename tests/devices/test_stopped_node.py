"""A node that is stopped for a second, a minute or half an hour, behind any of its operations.

A debugger, SIGSTOP, a paused container and a driver that hangs look the same to the acquisition:
time passes behind one operation. The chips go on: a commanded conversion waits, and grows old; a
free-running part converts, and keeps its newest conversions.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from smbus2 import i2c_msg

from devices.acquisition import SAMPLE_OFFSET_MAX_NS, AcquiredFrame, Acquisition
from devices.array.startup import prepare_array
from devices.array.tile import HELD_UP_NS
from devices.buses.i2c import open_bus
from devices.clock import VirtualClock
from devices.emulation.chips.bmp581 import EmulatedBmp581
from devices.emulation.chips.mpl115a2 import EmulatedMpl115a2
from devices.emulation.world import World
from devices.flags import FrameFlag, TileFlag
from devices.frames import NOT_READ, FrameBatch
from devices.scene.hardware_sections import ScheduleName
from devices.scene.scene_file import load_scene, replace_chips, validate_scene
from storage.frame_rules import describe_first_broken_rule
from tests.builders.arrays import make_array
from tests.devices.feet import ANCHOR
from tests.devices.rigs import Adapter, counting

STOPS_S = [1, 61, 2200]
"""Less and more than the minute that a server accepts, and more than 2^31 us."""
FRAMES_BETWEEN = 6
RATE_HZ = 100.0
INSTANT_ERROR_MAX_NS = HELD_UP_NS + 20_000_000


class StoppableClock(VirtualClock):
    """Clock of a driver, which is stopped behind one of its operations.

    Args:
        clock: clock of the machine.
    """

    def __init__(self, clock: VirtualClock) -> None:
        self._clock = clock
        self._stop_ns = self._operations_left = 0
        self.operations = 0

    def stop_behind(self, operations: int, stop_ns: int) -> None:
        """Stop for so long behind the next so many operations."""
        self._operations_left, self._stop_ns = operations, stop_ns

    @property
    def has_stopped(self) -> bool:
        return self._operations_left <= 0

    def end_operation(self) -> None:
        """Count an operation of the driver, and stop behind it if it is the one."""
        self.operations += 1
        self._operations_left -= 1
        if self._operations_left == 0:
            self._clock.sleep_until_ns(self._clock.now_ns() + self._stop_ns)

    def now_ns(self) -> int:
        t_ns = self._clock.now_ns()
        self.end_operation()
        return t_ns

    def sleep_until_ns(self, t_ns: int) -> None:
        self._clock.sleep_until_ns(t_ns)
        self.end_operation()


class StoppableAdapter(Adapter):
    """Adapter whose driver is stopped behind a transaction."""

    def __init__(self, world: World, clock: StoppableClock) -> None:
        self._adapter, self._clock = world.i2c_adapter, clock

    def i2c_rdwr(self, *messages: i2c_msg) -> None:
        try:
            self._adapter.i2c_rdwr(*messages)
        finally:
            self._clock.end_operation()


class FrameCounter:
    """Sink that counts frames."""

    next_seq = 0

    def write_frame(self, frame: AcquiredFrame) -> None:
        assert frame.seq == self.next_seq, "every frame has a number, in order"
        self.next_seq += 1


@dataclass
class StoppableFoot:
    """A foot whose samples are told by their counts, and its acquisition."""

    clock: StoppableClock
    machine: VirtualClock
    world: World
    stream: Acquisition
    counter: FrameCounter
    begins_ns: list[dict[int, int]]
    """Begin of the newest conversion of each tile with these counts."""

    def take(self, frames: int) -> FrameBatch:
        """Acquire so many frames."""
        end_seq = self.counter.next_seq + frames
        return FrameBatch.concatenate(
            list(self.stream.acquire_batches(lambda: self.counter.next_seq >= end_seq))
        )


def make_foot(
    chips: str, schedule: ScheduleName, *, has_reference: bool = False, **options: Any
) -> StoppableFoot:
    """Make a foot of two tiles: of `mpl115a2`, of `bmp581`, or `mixed`.

    Its reference force is the time in seconds, modulo a minute.
    """
    scene = load_scene("standing")
    content = (scene if chips == "mpl115a2" else replace_chips(scene, "bmp581")).model_dump()
    tiles = list(content["tile"])[:2]
    if chips == "mixed":
        tiles[0] = scene.model_dump()["tile"][0]
    content |= {"tile": tiles, "servo": None}
    scene = validate_scene(content, where="test")
    machine = VirtualClock()
    clock = StoppableClock(machine)
    world = World(scene, machine)
    machine.sleep_until_ns(10_000_000)

    def read_reference_n() -> float:
        clock.end_operation()
        force_n = machine.now_ns() * 1e-9 % 60
        clock.end_operation()
        return force_n

    array = prepare_array(
        open_bus("emulated", StoppableAdapter(world, clock)),
        scene,
        clock,
        schedule=schedule,
        read_reference_n=read_reference_n if has_reference else None,
    ).array
    begins_ns: list[dict[int, int]] = [{} for _ in world.chips]
    for tile, chip in enumerate(world.chips):
        if isinstance(chip, EmulatedMpl115a2):
            chip._silicon = replace(chip._silicon, sample_counts=counting(100 * tile))
        elif isinstance(chip, EmulatedBmp581):
            # The pressure tells the time, to a millisecond in a minute.
            chip._part = replace(chip._part, sample=lambda t_ns: (60 + t_ns * 1e-9 % 60, 25.0))
        chip.on_conversion = make_note(begins_ns[tile])
    counter = FrameCounter()
    stream = Acquisition(array, array.tiles, clock, ANCHOR, frame_sink=counter, **options)
    return StoppableFoot(clock, machine, world, stream, counter, begins_ns)


def make_note(begins_ns: dict[int, int]) -> Callable[[int, tuple[int, int], object], None]:
    def note(begin_ns: int, counts: tuple[int, int], _: object) -> None:
        begins_ns[counts[0]] = begin_ns

    return note


def find_instant_errors_ns(foot: StoppableFoot, batch: FrameBatch) -> list[float]:
    """Return the errors of the instants of all usable readings; infinite if it is no conversion's.

    A conversion begins a few milliseconds before its sample.
    """
    errors_ns = []
    for row, tile in np.argwhere((batch.tile_flags & TileFlag.UNUSABLE) == 0).tolist():
        sample_ns = int(batch.t_mono_ns[row]) + 1000 * int(batch.sample_offset_us[row, tile])
        begin_ns = foot.begins_ns[tile].get(int(batch.pressure_raw[row, tile]), math.inf)
        errors_ns.append(abs(sample_ns - begin_ns))
    return errors_ns


def count_operations(foot: StoppableFoot) -> int:
    """Return the number of operations until a stop in every place has been seen."""
    foot.take(20)
    begin = foot.clock.operations
    foot.take(FRAMES_BETWEEN)
    assert foot.clock.operations > begin + 40
    return foot.clock.operations - begin


FEET: list[tuple[str, ScheduleName]] = [
    ("mpl115a2", "simultaneous"),
    ("mpl115a2", "pipelined"),
    ("mpl115a2", "per_mux"),
    ("mpl115a2", "sequential"),
    ("bmp581", "pipelined"),
    ("bmp581", "sequential"),
    ("mixed", "pipelined"),
]


@pytest.mark.parametrize("stop_s", STOPS_S)
@pytest.mark.parametrize(("chips", "schedule"), FEET)
def test_a_stop_behind_any_operation_leaves_frames_that_say_what_was_read_when(
    chips: str, schedule: ScheduleName, stop_s: int
) -> None:
    """Each frame keeps to the rules of a server, and each usable reading has its true instant."""
    foot = make_foot(chips, schedule, rate_hz=RATE_HZ)
    info = make_array(foot.stream._array.tiles, utc_offset_ns=ANCHOR.offset_ns)
    for operation in range(1, count_operations(foot), 1 if stop_s == 61 else 5):
        foot.take(FRAMES_BETWEEN)
        missed_slots, begin_ns = foot.stream.missed_slots, foot.machine.now_ns()
        foot.clock.stop_behind(operation, stop_s * 1_000_000_000)
        batch = foot.take(2 * FRAMES_BETWEEN)
        assert foot.clock.has_stopped
        where = f"stopped behind operation {operation}"
        assert describe_first_broken_rule(batch, info) == "", where
        assert np.abs(batch.sample_offset_us).max() <= SAMPLE_OFFSET_MAX_NS // 1000 + 20_000, where
        unread = batch.pressure_raw == NOT_READ
        assert ((batch.tile_flags & TileFlag.UNUSABLE) != 0)[unread].all(), where
        assert max(find_instant_errors_ns(foot, batch)) < INSTANT_ERROR_MAX_NS, where
        lost = (batch.tile_flags & TileFlag.UNUSABLE) != 0
        assert lost.sum() <= 3, where
        assert not lost[-2:].any(), "and all tiles are read again"
        assert foot.machine.now_ns() - batch.t_mono_ns[-1] < 2e9 / RATE_HZ, "at the present time"
        missed = foot.stream.missed_slots - missed_slots
        slots = (foot.machine.now_ns() - begin_ns) * 1e-9 * RATE_HZ
        assert missed + 2 * FRAMES_BETWEEN == pytest.approx(slots, abs=2), "slots are counted"
        assert (batch.frame_flags & FrameFlag.OVERRUN).any()


@pytest.mark.parametrize("foot", [("mpl115a2", "simultaneous"), ("bmp581", "sequential")])
def test_a_reference_force_from_behind_a_stop_is_not_that_of_the_frame(
    foot: tuple[str, ScheduleName],
) -> None:
    one = make_foot(*foot, has_reference=True, rate_hz=RATE_HZ)
    unknown = frames = 0
    for operation in range(1, count_operations(one), 2):
        one.clock.stop_behind(operation, 61_000_000_000)
        batch = one.take(2 * FRAMES_BETWEEN)
        off_s = np.abs(batch.reference_force_n - batch.t_mono_ns * 1e-9 % 60)
        unknown += int(np.isnan(off_s).sum())
        frames += len(batch)
        assert not (off_s > INSTANT_ERROR_MAX_NS * 1e-9).any(), f"behind operation {operation}"
    assert 0 < unknown < 0.1 * frames


@pytest.mark.parametrize("lost", [[0], [1], [0, 1]])
@pytest.mark.parametrize(("chips", "schedule"), FEET)
def test_a_tile_that_is_lost_for_minutes_has_no_old_instant(
    chips: str, schedule: ScheduleName, lost: list[int]
) -> None:
    """Nor has a frame in which no tile is read the instant of its last reading."""
    foot = make_foot(chips, schedule, rate_hz=5.0)
    info = make_array(foot.stream._array.tiles, utc_offset_ns=ANCHOR.offset_ns)
    foot.take(5)
    with ExitStack() as stack:
        for tile in lost:
            serial = foot.world.scene.tile[tile].serial
            stack.enter_context(foot.world.inject_fault("unplugged", serial))
        batch = foot.take(500)
        assert foot.machine.now_ns() - batch.t_mono_ns[-1] < 500_000_000
    assert describe_first_broken_rule(batch, info) == ""
    assert (batch.tile_flags[:, lost] & TileFlag.UNUSABLE).all()
    assert np.abs(batch.sample_offset_us[:, lost]).max() < 500_000
    assert np.diff(batch.t_mono_ns[5:]) == pytest.approx(200_000_000, abs=20_000_000)
    assert not (foot.take(20).tile_flags[-1] & TileFlag.UNUSABLE).any()
