"""The acquisition of an emulated foot: numbers, times, rates, flags, servo and reference force."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from devices.acquisition import RangeDetector
from devices.buses.i2c import I2cBus
from devices.flags import FrameFlag, TileFlag
from devices.frames import NO_SERVO_AGE, NO_SERVO_COUNTS, NOT_READ, FrameBatch
from devices.scene.hardware_sections import ScheduleName
from tests.builders.arrays import DATA_SHEET_CHIP, make_tile
from tests.builders.frames import make_frames
from tests.builders.scenes import make_scene
from tests.devices.feet import Foot, array_of, foot
from tests.devices.rigs import SCHEDULES

FRAME_NS = 2_532_500  # simultaneous, four tiles, 400 kHz, 1.6 ms: bus_budget.py, strategy b
LOOK_NS = 165_000, 215_000
"""In one frame of ten a tile is read again before it is started, with or without a select."""


def four_tiles(
    *, noise_kpa: float = 0.06, fault: tuple[dict[str, Any], ...] = (), **how: Any
) -> Foot:
    """Return a foot of four typical tiles, with so little noise that no reading is a jump."""
    array = {"conversion_ms": 1.6, "wait_ms": 1.6}
    return foot(make_scene(array=array, emulation={"noise_kpa": noise_kpa}, fault=fault), **how)


def has_frame_length(batch: FrameBatch, frame_ns: int, looks: int = 1) -> bool:
    """Return whether frames are equally long, but for second looks in one frame of ten."""
    late_ns = np.diff(batch.t_mono_ns) - frame_ns
    looked = np.isin(np.abs(late_ns), list(range(165_000, looks * 215_000 + 1, 5_000)))
    return bool(((late_ns == 0) | looked).all() and looked.sum() <= 1 + looks * len(late_ns) / 10)


# Numbers and times


@pytest.mark.parametrize("schedule", SCHEDULES)
def test_frames_are_numbered_without_a_gap_and_their_time_rises(schedule: ScheduleName) -> None:
    one = four_tiles(schedule=schedule)
    batch = FrameBatch.concatenate([one.take(50), one.take(50)])  # the loop runs twice
    assert batch.seq.tolist() == list(range(len(batch)))
    assert (np.diff(batch.t_mono_ns) > 0).all()
    assert (batch.t_ns - batch.t_mono_ns == 1_577_836_800_000_000_000).all()


def test_the_time_of_a_simultaneous_frame_is_the_sample_instant_of_its_tiles() -> None:
    one = four_tiles()
    begin_ns = one.clock.now_ns()
    batch = one.take(20)
    # select and CONVERT: 20 + 29 periods of 2.5 us; the sample lies a quarter into 1.6 ms
    assert batch.t_mono_ns[0] == begin_ns + 122_500 + 400_000
    assert (batch.sample_offset_us == 0).all()


def test_tiles_of_a_sequential_frame_are_sampled_one_after_another() -> None:
    offset_us = four_tiles(schedule="sequential").take(5).sample_offset_us
    exact_us = 1887.5 * np.arange(4)
    without_look = np.abs(np.diff(offset_us, axis=1) - np.diff(exact_us)) < 1
    assert without_look.mean() > 0.8
    assert (np.abs(offset_us - exact_us) < 4 * 216).all()
    assert (offset_us[:, 0] == 0).all()


@pytest.mark.parametrize(
    ("schedule", "frame_ns"),
    [("simultaneous", FRAME_NS), ("sequential", 7_550_000), ("pipelined", 1_837_500)],
)
def test_a_stream_without_a_rate_runs_at_the_rate_of_the_bus(
    schedule: ScheduleName, frame_ns: int
) -> None:
    one = four_tiles(schedule=schedule)
    batch = one.take(50)
    assert has_frame_length(batch, frame_ns, looks=4)
    assert (batch.frame_flags == 0).all()
    assert one.stream.missed_slots == 0


def assert_every_frame_is_in_its_slot(batch: FrameBatch, rate_hz: float) -> None:
    """Allow a second look in a tenth of the frames, and no more delay in any."""
    period_ns = round(1e9 / rate_hz)
    phases_ns, counts = np.unique(batch.t_mono_ns % period_ns, return_counts=True)
    late_ns = batch.t_mono_ns % period_ns - phases_ns[counts.argmax()]
    late_ns = (late_ns + period_ns // 2) % period_ns - period_ns // 2
    assert (late_ns == 0).mean() >= 0.89
    assert set(late_ns.tolist()) <= {0, *LOOK_NS}


@pytest.mark.parametrize("rate_hz", [100.0, 250.0, 360.0])
def test_a_stream_of_a_set_rate_keeps_it_exactly(rate_hz: float) -> None:
    one = four_tiles(rate_hz=rate_hz)
    batch = one.run_for(0.9)  # up to the first audit
    assert_every_frame_is_in_its_slot(batch, rate_hz)
    assert len(batch) == pytest.approx(0.9 * rate_hz, abs=1)
    assert (batch.frame_flags == 0).all()
    assert one.stream.missed_slots == 0


def test_the_audit_of_a_second_costs_a_hundredth_of_it_at_most() -> None:
    one = four_tiles(noise_kpa=0.165, rate_hz=370.0)
    batch = one.run_for(4.0)
    assert one.stream.missed_slots <= 0.01 * 4 * 370
    assert (np.diff(batch.t_mono_ns) < 4 * FRAME_NS).all()
    slower = four_tiles(noise_kpa=0.165, rate_hz=100.0)
    slower.run_for(4.0)
    assert slower.stream.missed_slots == 0, "it fits into the pause between two frames"


@pytest.mark.parametrize("rate_hz", [396.0, 1000.0])
def test_a_rate_that_the_bus_does_not_reach_shows_as_missed_slots(rate_hz: float) -> None:
    one = four_tiles(rate_hz=rate_hz)
    begin_ns = one.clock.now_ns()
    batch = one.run_for(0.9)
    period_ns = round(1e9 / rate_hz)
    # Slot k begins at k periods; a frame belongs to the slot in which it began. A frame that began
    # with a second look at a tile is sampled later by that.
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
    assert rate_hz < 800 or has_frame_length(batch, FRAME_NS), "as fast as it can"


def test_a_consumer_that_pauses_shows_as_missed_slots() -> None:
    one = four_tiles(rate_hz=100.0)
    frames = one.stream.acquire_batches(lambda: False)
    first = next(frames)
    one.clock.sleep_until_ns(one.clock.now_ns() + 200_000_000)
    second = next(frames)
    gap_ns = int(second.t_mono_ns[0] - first.t_mono_ns[-1])
    assert one.stream.missed_slots == gap_ns // 10_000_000 - 1
    assert 18 <= one.stream.missed_slots <= 20
    assert second.frame_flags[0] == FrameFlag.OVERRUN
    assert (second.frame_flags[1:] == 0).all()
    assert second.seq[0] == first.seq[-1] + 1, "a missed slot has no number"


def test_a_stalled_loop_without_a_rate_counts_the_frames_that_it_missed() -> None:
    one = four_tiles()
    stream = one.acquire(expected_rate_hz=1e9 / FRAME_NS)
    batches = stream.acquire_batches(lambda: False)
    next(batches)
    assert stream.missed_slots == 0
    one.clock.sleep_until_ns(one.clock.now_ns() + 100 * FRAME_NS)
    after = next(batches)
    assert stream.missed_slots == 100
    assert after.frame_flags[0] & FrameFlag.OVERRUN
    assert not (after.frame_flags[1:] & FrameFlag.OVERRUN).any()


def test_a_slightly_slow_loop_misses_slots_without_an_overrun() -> None:
    one = four_tiles()
    expected_hz = 1.03e9 / FRAME_NS
    one.acquire(expected_rate_hz=expected_hz)
    begin_ns = one.clock.now_ns()
    batch = one.run_for(0.9)
    slots = (one.clock.now_ns() - begin_ns) * 1e-9 * expected_hz
    assert one.stream.missed_slots == pytest.approx(slots - len(batch), abs=1)
    assert one.stream.missed_slots > 5
    assert not (batch.frame_flags & FrameFlag.OVERRUN).any()


# Batches


def test_a_batch_has_at_least_one_frame_and_about_25_ms() -> None:
    batches = four_tiles().batches(0.5)
    assert {len(batch) for batch in batches[:-1]} == {10}  # nine are 22.8 ms, which is too short
    assert all(batch.pressure_raw.flags.c_contiguous and len(batch) for batch in batches)
    sizes = [len(batch) for batch in four_tiles(rate_hz=10.0).batches(1.0)]
    assert sizes[0] <= 2
    assert set(sizes[1:]) == {1}


def test_a_batch_is_not_changed_by_the_next_one() -> None:
    frames = four_tiles().stream.acquire_batches(lambda: False)
    first = next(frames)
    before = first.pressure_raw.copy(), first.seq.copy()
    next(frames)
    np.testing.assert_array_equal(first.pressure_raw, before[0])
    np.testing.assert_array_equal(first.seq, before[1])


def test_a_stream_ends_before_the_frame_after_its_end() -> None:
    one = four_tiles()
    assert list(one.stream.acquire_batches(lambda: True)) == []
    end_ns = one.clock.now_ns() + 3 * FRAME_NS + 1  # in the middle of a batch
    batches = list(one.stream.acquire_batches(lambda: one.clock.now_ns() >= end_ns))
    assert [len(batch) for batch in batches] == [4]


# Servo and reference force


class Servo:
    """A servo with the position that a test sets."""

    def __init__(self, reading: tuple[int, int] | None) -> None:
        self.reading = reading
        self.asked_ns: list[int] = []
        self.stale_after_ns = 30_000_000
        self.is_turn_known = True

    def find_latest_position(self, t_mono_ns: int) -> tuple[int, int] | None:
        self.asked_ns.append(t_mono_ns)
        return self.reading


@pytest.mark.parametrize(("servo", "flags"), [(None, 0), (Servo(None), FrameFlag.SERVO_STALE)])
def test_frames_without_a_position_have_neither_counts_nor_age(
    servo: Servo | None, flags: int
) -> None:
    one = four_tiles()
    one.acquire(servo=servo)
    batch = one.take(3)
    assert set(batch.servo_counts.tolist()) == {NO_SERVO_COUNTS}
    assert set(batch.servo_age_us.tolist()) == {NO_SERVO_AGE}
    assert (batch.frame_flags == flags).all()


def test_a_frame_has_the_newest_position_and_its_age() -> None:
    servo = Servo((-4097, 1_000))
    one = four_tiles(start_ns=0)
    one.acquire(servo=servo)
    batch = one.take(30)
    assert set(batch.servo_counts.tolist()) == {-4097}
    age_ns = batch.t_mono_ns - 1_000
    assert batch.servo_age_us.tolist() == (age_ns // 1000).tolist()
    assert servo.asked_ns == batch.t_mono_ns.tolist()
    stale = (batch.frame_flags & FrameFlag.SERVO_STALE) != 0
    assert stale.tolist() == (age_ns > 30_000_000).tolist()
    assert stale.any()
    assert not stale.all()


def test_a_position_of_an_unknown_turn_is_flagged() -> None:
    servo = Servo((2048, 0))
    one = four_tiles(start_ns=0)
    one.acquire(servo=servo)
    for is_known, flags in ((False, FrameFlag.SERVO_TURN_UNKNOWN), (True, 0)):
        servo.reading = (2048, one.clock.now_ns())
        servo.is_turn_known = is_known
        batch = one.take(3)
        assert (batch.servo_counts == 2048).all(), "counts are stored as read"
        assert (batch.frame_flags == flags).all()


def test_a_position_an_hour_old_is_stale() -> None:
    # 2^31 us are 36 minutes, and the column is int32.
    one = four_tiles(start_ns=3_600_000_000_000)
    one.acquire(servo=Servo((2048, 0)))
    batch = one.take(3)
    assert (batch.servo_counts == 2048).all()
    assert (batch.frame_flags & FrameFlag.SERVO_STALE).all()
    assert (batch.servo_age_us > 30_000_000).all()


def test_a_frame_has_the_reference_force_at_its_instant() -> None:
    one = four_tiles()
    assert np.isnan(one.take(3).reference_force_n).all()
    bus = I2cBus(one.world.i2c_adapter, "emulated")
    one.array = array_of(
        bus, one.world.scene.tile, one.clock, read_reference_n=lambda: one.clock.now_ns() * 1e-9
    )
    one.acquire()
    batch = one.take(3)
    np.testing.assert_allclose(batch.reference_force_n, batch.t_mono_ns * 1e-9, rtol=1e-7)


# Faults and flags


def test_an_unplugged_tile_costs_neither_a_frame_nor_another_tile() -> None:
    fault = {"kind": "no_answer", "tile": "T02", "t_s": 0.2, "duration_s": 0.1}
    one = four_tiles(fault=(fault,), rate_hz=200.0)
    batch = one.run_for(0.5)
    gone = batch.tile_flags[:, 1] != 0
    assert set(batch.tile_flags[gone, 1].tolist()) == {TileFlag.NO_ANSWER}, "and not OVER_RANGE"
    # It is read about 2 ms after the frame's instant: a frame at the edge may be on either side.
    since_s = (batch.t_mono_ns - one.world.epoch_ns) * 1e-9
    assert gone[(since_s > 0.2) & (since_s < 0.294)].all()
    # It is looked for after 2, 4, 8, ... ms: found again after as long as it was away, at most.
    assert not gone[(since_s < 0.194) | (since_s > 0.4)].any()
    assert (batch.pressure_raw[gone, 1] == NOT_READ).all()
    assert (batch.temperature_raw[gone, 1] == NOT_READ).all()
    assert (batch.pressure_raw[~gone, 1] < 1024).all()
    assert (batch.pressure_raw[:, [0, 2, 3]] < 1024).all()
    assert (batch.tile_flags[:, [0, 2, 3]] == 0).all()
    assert_every_frame_is_in_its_slot(batch, 200.0)
    assert (batch.frame_flags == 0).all()


def test_a_bus_that_times_out_is_flagged_in_every_frame() -> None:
    one = four_tiles()
    before = one.take(2)
    with one.world.inject_fault("scl_low"):
        during = one.take(5)
    one.take(5)  # after a fault of the bus, tiles are verified before they are believed
    after = one.take(5)
    assert (during.frame_flags == FrameFlag.BUS_FAULT).all()
    assert (during.pressure_raw == NOT_READ).all()
    assert (during.tile_flags == TileFlag.NO_ANSWER).all()
    assert (after.frame_flags == 0).all()
    assert (after.tile_flags == 0).all()
    seq = np.concatenate([before.seq, during.seq])
    assert seq.tolist() == list(range(len(seq)))
    t_ns = np.concatenate([before.t_mono_ns, during.t_mono_ns, after.t_mono_ns])
    assert (np.diff(t_ns) > 0).all()
    assert (np.abs(during.sample_offset_us) <= 1).all()


def test_every_reading_outside_50_to_115_kpa_is_over_range() -> None:
    pressure_raw, temperature_raw = (
        column.reshape(-1, 1) for column in np.meshgrid(np.arange(1024), np.arange(300, 701))
    )
    batch = make_frames(
        pressure_raw.size, 1, pressure_raw=pressure_raw, temperature_raw=temperature_raw
    )
    RangeDetector((make_tile(registers=DATA_SHEET_CHIP),)).flag_out_of_range(batch)
    # data sheet eq. 1 and 2, in plain floats; a count of 0 or 1 fell through zero
    pcomp = (
        2009.75
        + (-2.3758544921875 + 3314 / 2**22 * temperature_raw) * pressure_raw
        - 0.92047119140625 * temperature_raw
    )
    kpa = pcomp * 65 / 1023 + 50
    is_inside = (kpa >= 50) & (kpa <= 115) & (pressure_raw > 1)
    np.testing.assert_array_equal(batch.tile_flags, np.where(is_inside, 0, TileFlag.OVER_RANGE))
    # At 507 counts of temperature 115 kPa is at 263.3 (hardware.md 1.3), and 50 kPa at 781.2.
    # Above 1023 a count wraps: at face value 1000 is some 23 kPa.
    flags = batch.tile_flags[temperature_raw[:, 0] == 507, 0]
    assert np.flatnonzero(flags == 0).tolist() == list(range(264, 782))


@pytest.mark.parametrize("flag", list(TileFlag))
def test_an_unusable_reading_is_not_also_over_range(flag: TileFlag) -> None:
    batch = make_frames(1, 1, pressure_raw=0, temperature_raw=507, tile_flags=flag)
    RangeDetector((make_tile(registers=DATA_SHEET_CHIP),)).flag_out_of_range(batch)
    added = 0 if flag & TileFlag.UNUSABLE else TileFlag.OVER_RANGE
    assert batch.tile_flags[0, 0] == flag | added
