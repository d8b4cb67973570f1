"""The paced loop over an emulated foot: numbers, times, rates, and what stands beside."""

from __future__ import annotations

import numpy as np
import pytest

from devices.acquisition import Acquisition
from devices.array.schedules import BusTiming
from devices.array.tile_array import TileArray
from devices.buses.i2c import I2cBus
from devices.flags import FrameFlag
from devices.frames import NO_SERVO_AGE, NO_SERVO_COUNTS, FrameBatch
from devices.scene.hardware_sections import ScheduleName
from devices.scene.scene_file import Scene
from tests.builders.scenes import make_scene
from tests.devices.feet import (
    ANCHOR,
    FRAME_NS,
    LIVELY,
    LOOK_NS,
    TYPICAL,
    Foot,
    at_its_own_pace,
    foot,
)
from tests.devices.rigs import SCHEDULES


def at_the_pace_of_the_bus(batch: FrameBatch, frame_ns: int, looks: int = 1) -> bool:
    """To the nanosecond, but for second looks in one frame of ten."""
    late_ns = np.diff(batch.t_mono_ns) - frame_ns
    looked = np.isin(np.abs(late_ns), list(range(165_000, looks * 215_000 + 1, 5_000)))
    return bool(((late_ns == 0) | looked).all() and looked.sum() <= 1 + looks * len(late_ns) / 10)


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
    assert (batch.frame_flags == 0).all()
    assert one.stream.missed_slots == 0


@pytest.mark.parametrize("rate_hz", [100.0, 250.0, 360.0])
def test_a_paced_stream_keeps_its_rate_exactly(rate_hz: float) -> None:
    one = foot(make_scene(array=TYPICAL, emulation=LIVELY), rate_hz=rate_hz)
    batch = one.run_for(0.9)  # up to the first audit, which has a test of its own
    assert at_its_own_pace(batch, rate_hz)
    assert len(batch) == pytest.approx(0.9 * rate_hz, abs=1)
    assert (batch.frame_flags == 0).all()
    assert one.stream.missed_slots == 0


@pytest.mark.slow
def test_the_audit_of_a_second_costs_a_hundredth_of_it_at_most() -> None:
    one = foot(make_scene(array=TYPICAL, emulation={"noise_kpa": 0.165}), rate_hz=370.0)
    batch = one.run_for(10.0)
    assert one.stream.missed_slots <= 0.01 * 3700
    assert (np.diff(batch.t_mono_ns) < 4 * FRAME_NS).all()
    slower = foot(make_scene(array=TYPICAL, emulation={"noise_kpa": 0.165}), rate_hz=100.0)
    slower.run_for(10.0)
    assert slower.stream.missed_slots == 0, "it fits into the pause between two frames"


@pytest.mark.slow
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
    overrun = (batch.frame_flags & FrameFlag.OVERRUN) != 0
    assert not overrun[0]
    known = sure[1:] & sure[:-1]
    assert known.mean() > 0.3 or rate_hz > 800
    assert overrun[1:][known].tolist() == (np.diff(slot) > 1)[known].tolist()
    if rate_hz > 800:
        assert at_the_pace_of_the_bus(batch, FRAME_NS), "as fast as it can"


def test_a_consumer_that_dawdles_is_counted_and_not_waited_for() -> None:
    one = foot(make_scene(array=TYPICAL, emulation=LIVELY), rate_hz=100.0)
    frames = one.stream.acquire_batches(lambda: False)
    first = next(frames)
    one.clock.sleep_until_ns(one.clock.now_ns() + 200_000_000)
    second = next(frames)
    gap_ns = int(second.t_mono_ns[0] - first.t_mono_ns[-1])
    assert one.stream.missed_slots == gap_ns // 10_000_000 - 1
    assert 18 <= one.stream.missed_slots <= 20
    assert second.frame_flags[0] == FrameFlag.OVERRUN
    assert (second.frame_flags[1:] == 0).all()
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
        assert batch.pressure_raw.flags.c_contiguous
        assert batch.tile_flags.flags.c_contiguous


def test_a_batch_is_not_touched_by_the_next_one() -> None:
    frames = foot(make_scene(array=TYPICAL, emulation=LIVELY)).stream.acquire_batches(lambda: False)
    first = next(frames)
    kept = first.pressure_raw.copy(), first.seq.copy()
    next(frames)
    np.testing.assert_array_equal(first.pressure_raw, kept[0])
    np.testing.assert_array_equal(first.seq, kept[1])


def test_nothing_is_taken_when_the_end_has_come_already() -> None:
    one = foot(make_scene(array=TYPICAL, emulation=LIVELY))
    assert list(one.stream.acquire_batches(lambda: True)) == []


def test_the_end_is_looked_for_before_every_frame() -> None:
    one = foot(make_scene(array=TYPICAL, emulation=LIVELY))
    begin_ns = one.clock.now_ns()
    end_ns = begin_ns + 3 * FRAME_NS + 1  # in the middle of a batch
    batches = list(one.stream.acquire_batches(lambda: one.clock.now_ns() >= end_ns))
    assert [len(batch) for batch in batches] == [4]


# Servo and reference


class Servo:
    """Positions by hand: the newest reading, and when it was taken."""

    def __init__(self, reading: tuple[int, int] | None) -> None:
        self.reading = reading
        self.asked_ns: list[int] = []
        self.stale_after_ns = 30_000_000
        self.is_turn_known = True

    def find_latest_position(self, t_mono_ns: int) -> tuple[int, int] | None:
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
    assert (batch.frame_flags == 0).all()


def test_a_servo_that_has_not_answered_yet_is_stale() -> None:
    batch = with_servo(make_scene(array=TYPICAL, emulation=LIVELY), Servo(None)).take(3)
    assert set(batch.servo_counts.tolist()) == {NO_SERVO_COUNTS}
    assert set(batch.servo_age_us.tolist()) == {NO_SERVO_AGE}
    assert (batch.frame_flags == FrameFlag.SERVO_STALE).all()


def test_the_newest_position_goes_with_a_frame_and_ages() -> None:
    servo = Servo((-4097, 1_000))
    batch = with_servo(make_scene(array=TYPICAL, emulation=LIVELY), servo).take(30)
    assert set(batch.servo_counts.tolist()) == {-4097}
    age_ns = batch.t_mono_ns - 1_000
    assert batch.servo_age_us.tolist() == (age_ns // 1000).tolist()
    assert servo.asked_ns == batch.t_mono_ns.tolist()
    stale = (batch.frame_flags & FrameFlag.SERVO_STALE) != 0
    assert stale.tolist() == (age_ns > 30_000_000).tolist()
    assert stale.any()
    assert not stale.all()


def test_a_position_whose_turn_is_not_known_says_so() -> None:
    servo = Servo((2048, 0))
    one = with_servo(make_scene(array=TYPICAL, emulation=LIVELY), servo)
    servo.is_turn_known = False
    batch = one.take(3)
    assert (batch.servo_counts == 2048).all(), "counts are kept as they were read"
    assert ((batch.frame_flags & FrameFlag.SERVO_TURN_UNKNOWN) != 0).all()
    servo.is_turn_known = True
    assert ((one.take(3).frame_flags & FrameFlag.SERVO_TURN_UNKNOWN) == 0).all()


def test_a_servo_that_died_an_hour_ago_does_not_stop_the_stream() -> None:
    # 2^31 us are 36 minutes, and int32 is what the column has.
    servo = Servo((2048, 0))
    one = with_servo(make_scene(array=TYPICAL, emulation=LIVELY), servo, start_ns=3_600_000_000_000)
    batch = one.take(3)
    assert (batch.servo_counts == 2048).all()
    assert (batch.frame_flags & FrameFlag.SERVO_STALE).all()
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
        read_reference_n=lambda: one.clock.now_ns() * 1e-9,
    )
    one.stream = Acquisition(array, array.tiles, one.clock, ANCHOR)
    batch = one.take(3)
    # It is sampled at the very instant of the first tile.
    np.testing.assert_allclose(batch.reference_force_n, batch.t_mono_ns * 1e-9, rtol=1e-7)


# The same foot again


def test_the_same_scene_gives_the_same_frames_to_the_bit() -> None:
    scene = make_scene(array=TYPICAL, emulation={"noise_kpa": 0.165})
    first, second = foot(scene).take(50), foot(scene).take(50)
    np.testing.assert_array_equal(first.pressure_raw, second.pressure_raw)
    np.testing.assert_array_equal(first.temperature_raw, second.temperature_raw)
    np.testing.assert_array_equal(first.t_mono_ns, second.t_mono_ns)
    assert len(set(first.pressure_raw[:, 0].tolist())) > 3, "noise and all"


# A loop without a rate of its own


def test_a_loop_that_was_stalled_says_how_many_frames_it_missed() -> None:
    one = foot(make_scene(array=TYPICAL, emulation=LIVELY))
    stream = Acquisition(
        one.array, one.array.tiles, one.clock, ANCHOR, expected_rate_hz=1e9 / FRAME_NS
    )
    batches = stream.acquire_batches(lambda: False)
    before = next(batches)
    assert stream.missed_slots == 0
    one.clock.sleep_until_ns(one.clock.now_ns() + 100 * FRAME_NS)
    after = next(batches)
    assert stream.missed_slots == 100
    assert after.frame_flags[0] & FrameFlag.OVERRUN
    assert not (after.frame_flags[1:] & FrameFlag.OVERRUN).any()
    assert after.seq[0] == before.seq[-1] + 1  # what was not taken never had a number


def test_a_loop_that_is_a_little_slow_misses_slots_without_a_stall() -> None:
    one = foot(make_scene(array=TYPICAL, emulation=LIVELY))
    expected_hz = 1.03e9 / FRAME_NS
    one.stream = Acquisition(
        one.array, one.array.tiles, one.clock, ANCHOR, expected_rate_hz=expected_hz
    )
    begin_ns = one.clock.now_ns()
    batch = one.run_for(0.9)
    slots = (one.clock.now_ns() - begin_ns) * 1e-9 * expected_hz
    assert one.stream.missed_slots == pytest.approx(slots - len(batch), abs=1)
    assert one.stream.missed_slots > 5
    assert not (batch.frame_flags & FrameFlag.OVERRUN).any()
