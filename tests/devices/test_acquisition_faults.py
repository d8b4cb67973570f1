"""The acquisition while something fails, and the flags of single readings."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from smbus2 import i2c_msg

from devices.buses.i2c import I2cAdapter
from devices.clock import VirtualClock
from devices.errors import BusMisuseError
from devices.flags import FrameFlag, TileFlag
from devices.frames import NOT_READ, FrameBatch
from devices.scene.scene_file import Scene
from tests.builders.scenes import make_scene
from tests.devices.feet import FRAME_NS, LIVELY, TYPICAL, Foot, at_its_own_pace, foot, reading


def has(bits: int, batch: FrameBatch, tile: int) -> list[bool]:
    return [bool(status & bits) for status in batch.tile_flags[:, tile]]


# Faults while it runs


def test_a_plug_pulled_by_a_scene_costs_one_tile_and_no_frame() -> None:
    fault = {"kind": "no_answer", "tile": "T02", "t_s": 0.2, "duration_s": 0.1}
    one = foot(make_scene(array=TYPICAL, emulation=LIVELY, fault=[fault]), rate_hz=200.0)
    begin_ns = one.world.epoch_ns
    batch = one.run_for(0.5)
    gone = np.array(has(TileFlag.NO_ANSWER, batch, 1))
    # Read about 2 ms after the frame's instant: a frame at the edge may be on either side.
    since_s = (batch.t_mono_ns - begin_ns) * 1e-9
    assert gone[(since_s > 0.2) & (since_s < 0.294)].all()
    # Looked for at 2, 4, 8, ... ms: found again after as long as it was away, at most.
    assert not gone[(since_s < 0.194) | (since_s > 0.4)].any()
    assert (batch.pressure_raw[gone, 1] == NOT_READ).all()
    assert (batch.temperature_raw[gone, 1] == NOT_READ).all()
    assert (batch.pressure_raw[~gone, 1] < 1024).all()
    for other in (0, 2, 3):
        assert (batch.pressure_raw[:, other] < 1024).all()
        assert (batch.tile_flags[:, other] == 0).all()
    assert at_its_own_pace(batch, 200.0)
    assert (batch.frame_flags == 0).all()


def test_a_plug_can_be_pulled_by_hand_under_a_running_stream() -> None:
    one = foot(make_scene(array=TYPICAL, emulation=LIVELY))
    frames = one.stream.acquire_batches(lambda: False)
    assert not any(has(TileFlag.NO_ANSWER, next(frames), 2))
    with one.world.inject_fault("no_answer", "T03"):
        during = next(frames)
    next(frames)
    after = next(frames)
    assert all(has(TileFlag.NO_ANSWER, during, 2))
    assert (during.pressure_raw[:, 2] == NOT_READ).all()
    assert (during.pressure_raw[:, [0, 1, 3]] < 1024).all()
    assert (np.diff(during.t_mono_ns) <= FRAME_NS + 100_000).all(), "the rate stays"
    assert (after.tile_flags == 0).all()


def test_a_part_that_stops_converting_becomes_stale() -> None:
    scene = make_scene(array=TYPICAL, emulation={"noise_kpa": 0.165})
    one = foot(scene)
    before = one.take(3)
    with one.world.inject_fault("stale", "T04"):
        during = one.take(60)
    one.take(1)
    after = one.take(5)
    stale = has(TileFlag.STALE, during, 3)
    first = stale.index(True)
    # Ten in a row (one in nine is equal by chance); the last before the fault may be one of them.
    assert 7 <= first <= 10
    assert all(stale[first:])
    assert (
        len(
            set(
                zip(
                    during.pressure_raw[:, 3].tolist(),
                    during.temperature_raw[:, 3].tolist(),
                    strict=True,
                )
            )
        )
        == 1
    )
    for batch in (before, after):
        assert not any(has(TileFlag.STALE, batch, 3))
    for other in range(3):
        assert not any(has(TileFlag.STALE, during, other))


@pytest.mark.slow
def test_an_array_with_noise_is_not_called_stale() -> None:
    scene = make_scene(((0x70, 0),), emulation={"noise_kpa": 0.165}, array=TYPICAL)
    batch = foot(scene).run_for(20.0)
    assert (batch.tile_flags == 0).all()
    same = (np.diff(batch.pressure_raw[:, 0].astype(int)) == 0) & (
        np.diff(batch.temperature_raw[:, 0].astype(int)) == 0
    )
    assert 0.05 < same.mean() < 0.2, "about one in nine, as devices.array.tile says"


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
    assert sorted(batch.tile_flags[0].tolist()) == [0, 0, 0, TileFlag.RETRIED]
    assert (batch.tile_flags[1:] == 0).all()
    assert (batch.pressure_raw < 1024).all()


def test_a_bus_that_times_out_is_a_flag_and_every_frame_is_still_a_frame() -> None:
    one, adapter = failing_foot(make_scene(array=TYPICAL, emulation=LIVELY))
    before = one.take(2)
    adapter.number, adapter.fails = 110, lambda _: True
    during = one.take(5)
    adapter.fails = lambda _: False
    one.take(5)  # tiles of a bus that was stuck are looked at before they are believed
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


def test_a_foot_without_a_single_answer_gives_frames_that_say_so() -> None:
    one, adapter = failing_foot(make_scene(array=TYPICAL, emulation=LIVELY))
    adapter.clock, adapter.fails = None, lambda messages: bool(messages[0].addr == 0x60)
    batch = one.take(10)
    assert batch.seq.tolist() == list(range(len(batch)))
    assert (batch.pressure_raw == NOT_READ).all()
    assert (batch.temperature_raw == NOT_READ).all()
    assert ((batch.tile_flags & TileFlag.NO_ANSWER) != 0).all()
    assert (batch.frame_flags == 0).all(), "the tiles are silent, the bus is not broken"
    assert (np.diff(batch.t_mono_ns) > 0).all()


@pytest.mark.parametrize("number", [22, 95])
def test_a_bug_of_ours_is_raised_and_not_swallowed(number: int) -> None:
    one, adapter = failing_foot(make_scene(array=TYPICAL, emulation=LIVELY))
    one.take(1)
    adapter.clock, adapter.number, adapter.fails = None, number, lambda _: True
    with pytest.raises(BusMisuseError):
        one.take(1)


@pytest.mark.parametrize(
    ("pressure_raw", "temperature_raw", "tile_flags"),
    [
        (410, 507, 0),
        (264, 507, 0),  # 115 kPa is at 263.3 (hardware.md 1.3)
        (263, 507, TileFlag.OVER_RANGE),
        (1, 507, TileFlag.OVER_RANGE),
        (0, 507, TileFlag.OVER_RANGE),
        (1000, 507, TileFlag.OVER_RANGE),  # wrapped: at face value some 23 kPa
        (1023, 507, TileFlag.OVER_RANGE),
        (781, 507, 0),  # 50 kPa, Pcomp 0, is at 781.2
        (782, 507, TileFlag.OVER_RANGE),
        (0, 0, TileFlag.NOT_CONVERTED),
        (1023, 1023, TileFlag.IMPLAUSIBLE),
    ],
)
def test_a_reading_is_flagged_and_kept_as_it_is(
    pressure_raw: int, temperature_raw: int, tile_flags: int
) -> None:
    assert reading(pressure_raw, temperature_raw) == (pressure_raw, temperature_raw, tile_flags)


@settings(max_examples=40)
@given(pressure_raw=st.integers(2, 1022), temperature_raw=st.integers(300, 700))
def test_over_range_is_what_lies_outside_50_to_115_kpa(
    pressure_raw: int, temperature_raw: int
) -> None:
    # data sheet eq. 1 and 2, in plain floats
    pcomp = (
        2009.75
        + (-2.3758544921875 + 3314 / 2**22 * temperature_raw) * pressure_raw
        - 0.92047119140625 * temperature_raw
    )
    kpa = pcomp * 65 / 1023 + 50
    status = reading(pressure_raw, temperature_raw)[2]
    assert status == (0 if 50 <= kpa <= 115 else TileFlag.OVER_RANGE)


def test_a_tile_that_was_not_read_is_not_called_over_range() -> None:
    one = foot(make_scene(array=TYPICAL, emulation=LIVELY))
    with one.world.inject_fault("no_answer", "T01"):
        assert set(one.take(5).tile_flags[:, 0].tolist()) == {int(TileFlag.NO_ANSWER)}
