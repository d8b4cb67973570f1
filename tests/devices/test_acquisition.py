"""The paced loop over an emulated foot: numbers, times, rates, flags, and faults while it runs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from smbus2 import i2c_msg

from devices.acquisition import Acquisition
from devices.array.array import TileArray
from devices.array.budget import BusTiming
from devices.array.self_test import identify
from devices.buses.i2c import I2cAdapter, I2cBus, open_bus
from devices.clock import UtcAnchor, VirtualClock
from devices.emulation.buses.i2c import EmulatedI2cAdapter
from devices.emulation.chips.mpl115a2 import EmulatedMpl115a2, Silicon
from devices.emulation.chips.tca9548a import EmulatedTca9548a
from devices.emulation.world import World
from devices.errors import BusMisuseError, BusSetupError
from devices.frames import (
    NO_SERVO_AGE,
    NO_SERVO_COUNTS,
    NOT_READ,
    FrameBatch,
    FrameStatus,
    TileStatus,
)
from devices.scene.file import Scene
from devices.scene.hardware import ScheduleName, TileScene
from tests.builders.scenes import make_scene
from tests.devices.rigs import SCHEDULES, SETTLED

ANCHOR = UtcAnchor.of(0, 1_577_836_800_000_000_000, clock_set=True)
FRAME_NS = 2_532_500  # simultaneous, four tiles, 400 kHz, 1.6 ms: bus_budget.py, strategy b
TYPICAL = {"conversion_ms": 1.6, "wait_ms": 1.6}
LIVELY = {"noise_kpa": 0.06}
"""So quiet that no reading is far from those before, and not so quiet that a part seems stuck."""


@dataclass
class Foot:
    """An emulated foot and its driver."""

    world: World
    clock: VirtualClock
    array: TileArray
    stream: Acquisition

    def take(self, frames: int) -> FrameBatch:
        """So many frames, or a batch more."""
        batches: list[FrameBatch] = []
        for batch in self.stream.run(lambda: False):
            batches.append(batch)
            if sum(map(len, batches)) >= frames:
                break
        return FrameBatch.concatenate(batches)

    def run_for(self, seconds: float) -> FrameBatch:
        return FrameBatch.concatenate(self.batches(seconds))

    def batches(self, seconds: float) -> list[FrameBatch]:
        end_ns = self.clock.now_ns() + round(seconds * 1e9)
        return list(self.stream.run(lambda: self.clock.now_ns() >= end_ns))


def foot(
    scene: Scene,
    *,
    rate_hz: float = 0.0,
    wrap: Callable[[I2cAdapter], I2cAdapter] = lambda adapter: adapter,
    schedule: ScheduleName | None = None,
    start_ns: int = 3_000_000_000,
) -> Foot:
    clock = VirtualClock(start_ns)
    world = World(scene, clock, lead_s=0.0, begun=False)
    array = array_of(open_bus("emulated", wrap(world.i2c_adapter)), scene.tile, clock, schedule)
    for _ in range(SETTLED + 1):  # what has no history yet is read twice
        array.scan()
    world.begin()
    stream = Acquisition(array, array.tiles, clock, ANCHOR, rate_hz=rate_hz)
    return Foot(world, clock, array, stream)


def array_of(
    bus: I2cBus,
    tiles: Sequence[TileScene],
    clock: VirtualClock,
    schedule: ScheduleName | None = None,
) -> TileArray:
    found = identify(bus, tiles)
    timing = BusTiming(400_000, (1.6e-3,) * len(found), tuple(tile.mux for tile in found))
    return TileArray(bus, found, clock, schedule=schedule or "simultaneous", timing=timing)


def has(bits: int, batch: FrameBatch, tile: int) -> list[bool]:
    return [bool(status & bits) for status in batch.status[:, tile]]


LOOK_NS = 165_000, 215_000
"""In one frame of ten a tile is read once more before it is started, with or without a select."""


def at_the_pace_of_the_bus(batch: FrameBatch, frame_ns: int, looks: int = 1) -> bool:
    """To the nanosecond, but for second looks in one frame of ten."""
    late_ns = np.diff(batch.t_mono_ns) - frame_ns
    looked = np.isin(np.abs(late_ns), list(range(165_000, looks * 215_000 + 1, 5_000)))
    return bool(((late_ns == 0) | looked).all() and looked.sum() <= 1 + looks * len(late_ns) / 10)


def at_its_own_pace(batch: FrameBatch, rate_hz: float) -> bool:
    """Every frame in its slot, a tenth of them later by a second look and none by more."""
    period_ns = round(1e9 / rate_hz)
    phase_ns = batch.t_mono_ns % period_ns
    phases_ns, counts = np.unique(phase_ns, return_counts=True)
    late_ns = (phase_ns - phases_ns[counts.argmax()] + period_ns // 2) % period_ns - period_ns // 2
    return bool((late_ns == 0).mean() >= 0.89 and set(late_ns.tolist()) <= {0, *LOOK_NS})


# Numbers and times


@pytest.mark.parametrize("schedule", SCHEDULES)
def test_frames_are_numbered_without_a_gap_and_their_time_rises(schedule: ScheduleName) -> None:
    batch = foot(make_scene(array=TYPICAL, emulation=LIVELY), schedule=schedule).take(100)
    assert batch.seq.tolist() == list(range(len(batch)))
    assert (np.diff(batch.t_mono_ns) > 0).all()
    assert (batch.t_ns - batch.t_mono_ns == 1_577_836_800_000_000_000).all()


def test_numbers_go_on_when_the_loop_is_run_again() -> None:
    one = foot(make_scene(array=TYPICAL, emulation=LIVELY))
    first, second = one.take(5), one.take(5)
    assert second.seq[0] == first.seq[-1] + 1
    assert second.t_mono_ns[0] > first.t_mono_ns[-1]


def test_the_time_of_a_frame_is_the_sample_instant_of_its_first_tile() -> None:
    one = foot(make_scene(array=TYPICAL, emulation=LIVELY))
    begin_ns = one.clock.now_ns()
    # select and CONVERT: 20 + 29 periods of 2.5 us; the sample lies a quarter into 1.6 ms
    assert one.take(1).t_mono_ns[0] == begin_ns + 122_500 + 400_000


def test_tiles_of_a_simultaneous_frame_are_sampled_together() -> None:
    batch = foot(make_scene(array=TYPICAL, emulation=LIVELY)).take(20)
    assert (batch.sample_offset_us == 0).all()


def test_tiles_of_a_sequential_frame_are_sampled_one_after_another() -> None:
    batch = foot(make_scene(array=TYPICAL, emulation=LIVELY), schedule="sequential").take(5)
    exact_us = 1887.5 * np.arange(4)
    plain = np.abs(np.diff(batch.sample_offset_us, axis=1) - np.diff(exact_us)) < 1
    assert plain.mean() > 0.8, "but for second looks"
    assert (np.abs(batch.sample_offset_us - exact_us) < 4 * 216).all()
    assert (batch.sample_offset_us[:, 0] == 0).all()


@pytest.mark.parametrize(
    ("schedule", "frame_ns"),
    [("simultaneous", FRAME_NS), ("sequential", 7_550_000), ("pipelined", 1_837_500)],
)
def test_an_unpaced_stream_runs_at_the_rate_of_the_bus(
    schedule: ScheduleName, frame_ns: int
) -> None:
    one = foot(make_scene(array=TYPICAL, emulation=LIVELY), schedule=schedule)
    batch = one.take(50)
    assert at_the_pace_of_the_bus(batch, frame_ns, looks=4)
    assert (batch.frame_status == 0).all()
    assert one.stream.missed_slots == 0


@pytest.mark.parametrize("rate_hz", [100.0, 250.0, 360.0])
def test_a_paced_stream_keeps_its_rate_exactly(rate_hz: float) -> None:
    one = foot(make_scene(array=TYPICAL, emulation=LIVELY), rate_hz=rate_hz)
    batch = one.run_for(0.9)  # up to the first audit, which has a test of its own
    assert at_its_own_pace(batch, rate_hz)
    assert len(batch) == pytest.approx(0.9 * rate_hz, abs=1)
    assert (batch.frame_status == 0).all()
    assert one.stream.missed_slots == 0


def test_the_audit_of_a_second_costs_a_hundredth_of_it_at_most() -> None:
    one = foot(make_scene(array=TYPICAL, emulation={"noise_kpa": 0.165}), rate_hz=370.0)
    batch = one.run_for(10.0)
    assert one.stream.missed_slots <= 0.01 * 3700
    assert (np.diff(batch.t_mono_ns) < 4 * FRAME_NS).all()
    slower = foot(make_scene(array=TYPICAL, emulation={"noise_kpa": 0.165}), rate_hz=100.0)
    slower.run_for(10.0)
    assert slower.stream.missed_slots == 0, "it fits into the pause between two frames"


@pytest.mark.parametrize("rate_hz", [396.0, 400.0, 1000.0, 5000.0])
def test_a_rate_that_the_bus_does_not_give_shows_as_missed_slots(rate_hz: float) -> None:
    one = foot(make_scene(array=TYPICAL, emulation=LIVELY), rate_hz=rate_hz)
    begin_ns = one.clock.now_ns()
    batch = one.run_for(0.9)
    period_ns = round(1e9 / rate_hz)
    # Slot k begins at k periods; a frame belongs to the slot in which it began. One that began with
    # a second look at a tile is sampled later by that.
    begun_ns = batch.t_mono_ns - 522_500 - begin_ns
    slot, slot_if_looked = begun_ns // period_ns, (begun_ns - max(LOOK_NS)) // period_ns
    sure = slot == slot_if_looked
    assert (np.diff(slot) >= (1 if rate_hz > 800 else 0)).all()
    assert abs(one.stream.missed_slots - (slot[-1] + 1 - len(batch))) <= 1
    assert one.stream.missed_slots > 0
    overrun = (batch.frame_status & FrameStatus.OVERRUN) != 0
    assert not overrun[0]
    known = sure[1:] & sure[:-1]
    assert known.mean() > 0.3 or rate_hz > 800
    assert overrun[1:][known].tolist() == (np.diff(slot) > 1)[known].tolist()
    if rate_hz > 800:
        assert at_the_pace_of_the_bus(batch, FRAME_NS), "as fast as it can"


def test_a_consumer_that_dawdles_is_counted_and_not_waited_for() -> None:
    one = foot(make_scene(array=TYPICAL, emulation=LIVELY), rate_hz=100.0)
    frames = one.stream.run(lambda: False)
    first = next(frames)
    one.clock.sleep_until_ns(one.clock.now_ns() + 200_000_000)
    second = next(frames)
    gap_ns = int(second.t_mono_ns[0] - first.t_mono_ns[-1])
    assert one.stream.missed_slots == gap_ns // 10_000_000 - 1
    assert 18 <= one.stream.missed_slots <= 20
    assert second.frame_status[0] == FrameStatus.OVERRUN
    assert (second.frame_status[1:] == 0).all()
    assert second.seq[0] == first.seq[-1] + 1, "a missed slot never had a number"


def test_batches_are_about_25_ms_long() -> None:
    one = foot(make_scene(array=TYPICAL, emulation=LIVELY))
    sizes = [len(batch) for batch in one.batches(1.0)]
    assert set(sizes[:-1]) == {10}  # nine would be 22.8 ms, which is not yet enough


def test_frames_that_are_further_apart_than_a_batch_come_one_by_one() -> None:
    slow = foot(make_scene(array=TYPICAL, emulation=LIVELY), rate_hz=10.0)
    sizes = [len(batch) for batch in slow.batches(1.0)]
    assert sizes[0] <= 2
    assert set(sizes[1:]) == {1}


def test_a_batch_is_contiguous_and_never_empty() -> None:
    for batch in foot(make_scene(array=TYPICAL, emulation=LIVELY)).batches(0.2):
        assert len(batch) > 0
        assert batch.padc.flags.c_contiguous
        assert batch.status.flags.c_contiguous


def test_a_batch_is_not_touched_by_the_next_one() -> None:
    frames = foot(make_scene(array=TYPICAL, emulation=LIVELY)).stream.run(lambda: False)
    first = next(frames)
    kept = first.padc.copy(), first.seq.copy()
    next(frames)
    np.testing.assert_array_equal(first.padc, kept[0])
    np.testing.assert_array_equal(first.seq, kept[1])


def test_nothing_is_taken_when_the_end_has_come_already() -> None:
    one = foot(make_scene(array=TYPICAL, emulation=LIVELY))
    assert list(one.stream.run(lambda: True)) == []


def test_the_end_is_looked_for_before_every_frame() -> None:
    one = foot(make_scene(array=TYPICAL, emulation=LIVELY))
    begin_ns = one.clock.now_ns()
    end_ns = begin_ns + 3 * FRAME_NS + 1  # in the middle of a batch
    batches = list(one.stream.run(lambda: one.clock.now_ns() >= end_ns))
    assert [len(batch) for batch in batches] == [4]


# Faults while it runs


def test_a_plug_pulled_by_a_scene_costs_one_tile_and_no_frame() -> None:
    fault = {"kind": "no_answer", "tile": "T02", "t_s": 0.2, "duration_s": 0.1}
    one = foot(make_scene(array=TYPICAL, emulation=LIVELY, fault=[fault]), rate_hz=200.0)
    begin_ns = one.world.epoch_ns
    batch = one.run_for(0.5)
    gone = np.array(has(TileStatus.NO_ANSWER, batch, 1))
    # Read about 2 ms after the frame's instant: a frame at the edge may be on either side.
    since_s = (batch.t_mono_ns - begin_ns) * 1e-9
    assert gone[(since_s > 0.2) & (since_s < 0.294)].all()
    # Looked for at 2, 4, 8, ... ms: found again after as long as it was away, at most.
    assert not gone[(since_s < 0.194) | (since_s > 0.4)].any()
    assert (batch.padc[gone, 1] == NOT_READ).all()
    assert (batch.tadc[gone, 1] == NOT_READ).all()
    assert (batch.padc[~gone, 1] < 1024).all()
    for other in (0, 2, 3):
        assert (batch.padc[:, other] < 1024).all()
        assert (batch.status[:, other] == 0).all()
    assert at_its_own_pace(batch, 200.0)
    assert (batch.frame_status == 0).all()


def test_a_plug_can_be_pulled_by_hand_under_a_running_stream() -> None:
    one = foot(make_scene(array=TYPICAL, emulation=LIVELY))
    frames = one.stream.run(lambda: False)
    assert not any(has(TileStatus.NO_ANSWER, next(frames), 2))
    with one.world.fault("no_answer", "T03"):
        during = next(frames)
    next(frames)
    after = next(frames)
    assert all(has(TileStatus.NO_ANSWER, during, 2))
    assert (during.padc[:, 2] == NOT_READ).all()
    assert (during.padc[:, [0, 1, 3]] < 1024).all()
    assert (np.diff(during.t_mono_ns) <= FRAME_NS + 100_000).all(), "the rate stays"
    assert (after.status == 0).all()


def test_a_part_that_stops_converting_becomes_stale() -> None:
    scene = make_scene(array=TYPICAL, emulation={"noise_kpa": 0.165})
    one = foot(scene)
    before = one.take(3)
    with one.world.fault("stale", "T04"):
        during = one.take(60)
    one.take(1)
    after = one.take(5)
    stale = has(TileStatus.STALE, during, 3)
    first = stale.index(True)
    # Ten in a row (one in nine is equal by chance); the last before the fault may be one of them.
    assert 7 <= first <= 10
    assert all(stale[first:])
    assert len(set(zip(during.padc[:, 3].tolist(), during.tadc[:, 3].tolist(), strict=True))) == 1
    for batch in (before, after):
        assert not any(has(TileStatus.STALE, batch, 3))
    for other in range(3):
        assert not any(has(TileStatus.STALE, during, other))


def test_an_array_with_noise_is_not_called_stale() -> None:
    scene = make_scene(((0x70, 0),), emulation={"noise_kpa": 0.165}, array=TYPICAL)
    batch = foot(scene).run_for(20.0)
    assert (batch.status == 0).all()
    same = (np.diff(batch.padc[:, 0].astype(int)) == 0) & (
        np.diff(batch.tadc[:, 0].astype(int)) == 0
    )
    assert 0.05 < same.mean() < 0.2, "about one in nine, as devices.array.health says"


class Failing:
    """An adapter that fails with an errno on every transaction that `fails` picks."""

    def __init__(self, adapter: I2cAdapter, clock: VirtualClock | None = None) -> None:
        self._adapter = adapter
        self.clock = clock
        self.number = 121
        self.fails: Callable[[tuple[i2c_msg, ...]], bool] = lambda _: False

    def i2c_rdwr(self, *i2c_msgs: i2c_msg) -> None:
        if self.fails(i2c_msgs):
            if self.clock is not None:  # the adapter's time-out passes
                self.clock.sleep_until_ns(self.clock.now_ns() + 30_000_000)
            raise OSError(self.number, "injected")
        self._adapter.i2c_rdwr(*i2c_msgs)

    def set_timeout(self, units_10ms: int) -> None:
        self._adapter.set_timeout(units_10ms)

    def close(self) -> None:
        self._adapter.close()


def failing_foot(scene: Scene) -> tuple[Foot, Failing]:
    made: list[Failing] = []

    def wrap(adapter: I2cAdapter) -> I2cAdapter:
        made.append(Failing(adapter))
        return made[0]

    one = foot(scene, wrap=wrap)
    made[0].clock = one.clock
    return one, made[0]


def test_a_single_missing_acknowledge_is_retried_and_flagged() -> None:
    one, adapter = failing_foot(make_scene(array=TYPICAL, emulation=LIVELY))
    one.take(5)
    pending = [True]
    adapter.clock = None
    reads = iter(range(1000))
    adapter.fails = lambda messages: (
        len(messages) == 2 and next(reads) == 1 and bool(pending) and pending.pop()
    )
    batch = one.take(5)
    assert sorted(batch.status[0].tolist()) == [0, 0, 0, TileStatus.RETRIED]
    assert (batch.status[1:] == 0).all()
    assert (batch.padc < 1024).all()


def test_a_bus_that_times_out_is_a_flag_and_every_frame_is_still_a_frame() -> None:
    one, adapter = failing_foot(make_scene(array=TYPICAL, emulation=LIVELY))
    before = one.take(2)
    adapter.number, adapter.fails = 110, lambda _: True
    during = one.take(5)
    adapter.fails = lambda _: False
    one.take(5)  # tiles of a bus that was stuck are looked at before they are believed
    after = one.take(5)
    assert (during.frame_status == FrameStatus.BUS_FAULT).all()
    assert (during.padc == NOT_READ).all()
    assert (during.status == TileStatus.NO_ANSWER).all()
    assert (after.frame_status == 0).all()
    assert (after.status == 0).all()
    seq = np.concatenate([before.seq, during.seq])
    assert seq.tolist() == list(range(len(seq)))
    t_ns = np.concatenate([before.t_mono_ns, during.t_mono_ns, after.t_mono_ns])
    assert (np.diff(t_ns) > 0).all()
    assert (np.abs(during.sample_offset_us) <= 1).all()


def test_a_foot_without_a_single_answer_gives_frames_that_say_so() -> None:
    one, adapter = failing_foot(make_scene(array=TYPICAL, emulation=LIVELY))
    adapter.clock, adapter.fails = None, lambda messages: bool(messages[0].addr == 0x60)
    batch = one.take(10)
    assert batch.seq.tolist() == list(range(len(batch)))
    assert (batch.padc == NOT_READ).all()
    assert (batch.tadc == NOT_READ).all()
    assert ((batch.status & TileStatus.NO_ANSWER) != 0).all()
    assert (batch.frame_status == 0).all(), "the tiles are silent, the bus is not broken"
    assert (np.diff(batch.t_mono_ns) > 0).all()


@pytest.mark.parametrize(
    ("number", "kind"), [(22, BusMisuseError), (95, BusMisuseError), (19, BusSetupError)]
)
def test_a_bug_of_ours_is_raised_and_not_swallowed(number: int, kind: type[Exception]) -> None:
    one, adapter = failing_foot(make_scene(array=TYPICAL, emulation=LIVELY))
    one.take(1)
    adapter.clock, adapter.number, adapter.fails = None, number, lambda _: True
    with pytest.raises(kind):
        one.take(1)


# Flags of single readings

DATA_SHEET = (0x3ECE, 0xB3F9, 0xC517, 0x33C8)


def reading(padc: int, tadc: int) -> tuple[int, int, int]:
    """Counts and status of a tile of the data sheet's part that measures these words."""
    clock = VirtualClock()
    chip = EmulatedMpl115a2(Silicon(DATA_SHEET, 1_600_000, lambda _: (padc, tadc)))
    adapter = EmulatedI2cAdapter([EmulatedTca9548a(0x70, {0: chip})], clock, 400_000)
    tile = TileScene(serial="T01", mux=0x70, channel=0, x_m=0.0, y_m=0.0, z_m=0.0)
    array = array_of(I2cBus(adapter, "emulated"), [tile], clock)
    frames = Acquisition(array, array.tiles, clock, ANCHOR).run(lambda: False)
    batch = next(frames)  # its first frame: later ones are stale
    return int(batch.padc[0, 0]), int(batch.tadc[0, 0]), int(batch.status[0, 0])


@pytest.mark.parametrize(
    ("padc", "tadc", "status"),
    [
        (410, 507, 0),
        (264, 507, 0),  # 115 kPa is at 263.3 (hardware.md 1.3)
        (263, 507, TileStatus.OVER_RANGE),
        (1, 507, TileStatus.OVER_RANGE),
        (0, 507, TileStatus.OVER_RANGE),
        (1000, 507, TileStatus.OVER_RANGE),  # wrapped: at face value some 23 kPa
        (1023, 507, TileStatus.OVER_RANGE),
        (781, 507, 0),  # 50 kPa, Pcomp 0, is at 781.2
        (782, 507, TileStatus.OVER_RANGE),
        (0, 0, TileStatus.NOT_CONVERTED),
        (1023, 1023, TileStatus.IMPLAUSIBLE),
    ],
)
def test_a_reading_is_flagged_and_kept_as_it_is(padc: int, tadc: int, status: int) -> None:
    assert reading(padc, tadc) == (padc, tadc, status)


@settings(max_examples=40)
@given(padc=st.integers(2, 1022), tadc=st.integers(300, 700))
def test_over_range_is_what_lies_outside_50_to_115_kpa(padc: int, tadc: int) -> None:
    # data sheet eq. 1 and 2, in plain floats
    pcomp = 2009.75 + (-2.3758544921875 + 3314 / 2**22 * tadc) * padc - 0.92047119140625 * tadc
    kpa = pcomp * 65 / 1023 + 50
    status = reading(padc, tadc)[2]
    assert status == (0 if 50 <= kpa <= 115 else TileStatus.OVER_RANGE)


def test_a_tile_that_was_not_read_is_not_called_over_range() -> None:
    one = foot(make_scene(array=TYPICAL, emulation=LIVELY))
    with one.world.fault("no_answer", "T01"):
        assert set(one.take(5).status[:, 0].tolist()) == {int(TileStatus.NO_ANSWER)}


# Servo and reference


class Servo:
    """Positions by hand: the newest reading, and when it was taken."""

    def __init__(self, reading: tuple[int, int] | None) -> None:
        self.reading = reading
        self.asked_ns: list[int] = []
        self.stale_after_ns = 30_000_000

    def latest(self, t_mono_ns: int) -> tuple[int, int] | None:
        self.asked_ns.append(t_mono_ns)
        return self.reading


def with_servo(scene: Scene, servo: Servo, start_ns: int = 0) -> Foot:
    one = foot(scene, start_ns=start_ns)
    one.stream = Acquisition(one.array, one.array.tiles, one.clock, ANCHOR, servo=servo)
    return one


def test_without_a_servo_position_and_age_say_so() -> None:
    batch = foot(make_scene(array=TYPICAL, emulation=LIVELY)).take(3)
    assert set(batch.servo_counts.tolist()) == {NO_SERVO_COUNTS}
    assert set(batch.servo_age_us.tolist()) == {NO_SERVO_AGE}
    assert (batch.frame_status == 0).all()


def test_a_servo_that_has_not_answered_yet_is_stale() -> None:
    batch = with_servo(make_scene(array=TYPICAL, emulation=LIVELY), Servo(None)).take(3)
    assert set(batch.servo_counts.tolist()) == {NO_SERVO_COUNTS}
    assert set(batch.servo_age_us.tolist()) == {NO_SERVO_AGE}
    assert (batch.frame_status == FrameStatus.SERVO_STALE).all()


def test_the_newest_position_goes_with_a_frame_and_ages() -> None:
    servo = Servo((-4097, 1_000))
    batch = with_servo(make_scene(array=TYPICAL, emulation=LIVELY), servo).take(30)
    assert set(batch.servo_counts.tolist()) == {-4097}
    age_ns = batch.t_mono_ns - 1_000
    assert batch.servo_age_us.tolist() == (age_ns // 1000).tolist()
    assert servo.asked_ns == batch.t_mono_ns.tolist()
    stale = (batch.frame_status & FrameStatus.SERVO_STALE) != 0
    assert stale.tolist() == (age_ns > 30_000_000).tolist()
    assert stale.any()
    assert not stale.all()


def test_a_servo_that_died_an_hour_ago_does_not_stop_the_stream() -> None:
    # 2^31 us are 36 minutes, and int32 is what the column has.
    servo = Servo((2048, 0))
    one = with_servo(make_scene(array=TYPICAL, emulation=LIVELY), servo, start_ns=3_600_000_000_000)
    batch = one.take(3)
    assert (batch.servo_counts == 2048).all()
    assert (batch.frame_status & FrameStatus.SERVO_STALE).all()
    assert (batch.servo_age_us > 30_000_000).all(), "old, however it is told"


def test_the_force_beside_the_array_goes_with_the_frame() -> None:
    one = foot(make_scene(array=TYPICAL, emulation=LIVELY))
    assert np.isnan(one.take(3).reference_force_n).all()
    timing = BusTiming(400_000, (1.6e-3,) * 4, (0x70,) * 4)
    bus = I2cBus(one.world.i2c_adapter, "emulated")
    array = TileArray(
        bus,
        one.array.tiles,
        one.clock,
        schedule="simultaneous",
        timing=timing,
        reference_n=lambda: one.clock.now_ns() * 1e-9,
    )
    one.stream = Acquisition(array, array.tiles, one.clock, ANCHOR)
    batch = one.take(3)
    # It is sampled at the very instant of the first tile.
    np.testing.assert_allclose(batch.reference_force_n, batch.t_mono_ns * 1e-9, rtol=1e-7)


# The same foot again


def test_the_same_scene_gives_the_same_frames_to_the_bit() -> None:
    scene = make_scene(array=TYPICAL, emulation={"noise_kpa": 0.165})
    first, second = foot(scene).take(50), foot(scene).take(50)
    np.testing.assert_array_equal(first.padc, second.padc)
    np.testing.assert_array_equal(first.tadc, second.tadc)
    np.testing.assert_array_equal(first.t_mono_ns, second.t_mono_ns)
    assert len(set(first.padc[:, 0].tolist())) > 3, "noise and all"


# A loop without a rate of its own


def test_a_loop_that_was_stalled_says_how_many_frames_it_missed() -> None:
    one = foot(make_scene(array=TYPICAL, emulation=LIVELY))
    stream = Acquisition(one.array, one.array.tiles, one.clock, ANCHOR, expected_hz=1e9 / FRAME_NS)
    batches = stream.run(lambda: False)
    before = next(batches)
    assert stream.missed_slots == 0
    one.clock.sleep_until_ns(one.clock.now_ns() + 100 * FRAME_NS)
    after = next(batches)
    assert stream.missed_slots == 100
    assert after.frame_status[0] & FrameStatus.OVERRUN
    assert not (after.frame_status[1:] & FrameStatus.OVERRUN).any()
    assert after.seq[0] == before.seq[-1] + 1  # what was not taken never had a number
