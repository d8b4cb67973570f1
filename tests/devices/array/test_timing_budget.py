"""Length of a frame on the wire by the published tables, and the choice of a schedule.

Golden numbers: hardware.md 4, frames a second for 1 to 64 tiles, eight to a mux.
"""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.array.schedules import (
    BusTiming,
    check_broadcast_channels,
    choose_schedule,
    compute_frame_s,
    compute_rates_hz,
    count_broadcast_channels,
    count_read_bits,
)
from devices.errors import SceneError
from devices.scene.hardware_sections import ScheduleName
from tests.devices.rigs import SCHEDULES, full


def timing(
    tiles: int,
    scl_hz: float = 400_000,
    *,
    bytes_read: float = 4.0,
    tc_ms: float = 1.6,
    transaction_us: float = 0.0,
    sleep_us: float = 0.0,
) -> BusTiming:
    return BusTiming(
        scl_hz,
        (tc_ms * 1e-3,) * tiles,
        tuple(mux for mux, _ in full(tiles)),
        count_read_bits(bytes_read),
        transaction_us * 1e-6,
        sleep_us * 1e-6,
    )


FAST = {"scl_hz": 400_000.0}
SLOW = {"scl_hz": 100_000.0}
# What Python on a Pi may reach.
PYTHON = {"transaction_us": 60.0, "sleep_us": 80.0}
LONGEST = {"tc_ms": 3.0}
TILES = (1, 2, 4, 8, 16, 32, 64)
A: ScheduleName = "sequential"
B: ScheduleName = "simultaneous"
C: ScheduleName = "pipelined"
D: ScheduleName = "per_mux"


@pytest.mark.parametrize(
    ("conditions", "schedule", "bytes_read", "rates_hz"),
    [
        (FAST, A, 4, (544, 265, 132, 66, 33, 17, 8)),
        (FAST, C, 4, (544, 544, 544, 435, 213, 106, 53)),
        (SLOW, B, 2, (422, 308, 217, 136, 76, 40, 21)),
        (SLOW, D, 4, (64, 32, 16)),
        (PYTHON, A, 2, (502, 238, 119, 59, 30, 15, 7)),
        (PYTHON, B, 4, (491, 403, 317, 223, 135, 76, 40)),
        (PYTHON, C, 2, (502, 502, 502, 296, 143, 72, 36)),
        (PYTHON, D, 2, (180, 90, 45)),
        (LONGEST, C, 4, (309, 309, 309, 309, 213, 106, 53)),
    ],
)
def test_the_predicted_rates_are_the_published_ones(
    conditions: dict[str, float],
    schedule: ScheduleName,
    bytes_read: int,
    rates_hz: tuple[int, ...],
) -> None:
    found_hz = [
        round(1 / compute_frame_s(schedule, timing(tiles, bytes_read=bytes_read, **conditions)))
        for tiles in TILES[-len(rates_hz) :]
    ]
    assert found_hz == list(rates_hz)


def test_frames_of_four_tiles_have_these_lengths() -> None:
    # By hand from the bits: 20, 29 and 66 periods of 2.5 us, and 1.6 ms.
    expected_us = {
        "simultaneous": (4 * 20 + 29 + 4 * 66) * 2.5 + 1600,
        "pipelined": (29 + 66) * 2.5 + 1600,
        "per_mux": (4 * 20 + 29 + 4 * 66) * 2.5 + 1600,
        "sequential": 4 * ((20 + 29 + 66) * 2.5 + 1600),
    }
    found = compute_rates_hz(timing(4))
    assert {name: 1e6 / hz for name, hz in found.items()} == pytest.approx(expected_us)
    assert [count_read_bits(n) for n in (2, 4, 8)] == [48, 66, 102]  # data sheet's figures


@settings(max_examples=60)
@given(
    tiles=st.integers(1, 64),
    scl_hz=st.sampled_from([100_000, 250_000, 400_000]),
    spread_ms=st.lists(st.floats(1.2, 3.0), min_size=64, max_size=64),
)
def test_slower_parts_never_make_a_faster_frame(
    tiles: int, scl_hz: int, spread_ms: list[float]
) -> None:
    muxes = timing(tiles).muxes
    drawn = BusTiming(scl_hz, tuple(ms * 1e-3 for ms in spread_ms[:tiles]), muxes)
    slowest = BusTiming(scl_hz, (max(drawn.conversions_s),) * tiles, muxes)
    fastest = BusTiming(scl_hz, (min(drawn.conversions_s),) * tiles, muxes)
    for schedule in SCHEDULES:
        least, most = compute_frame_s(schedule, fastest), compute_frame_s(schedule, slowest)
        assert least - 1e-12 <= compute_frame_s(schedule, drawn) <= most + 1e-12


# Broadcast


@pytest.mark.parametrize(("schedule", "width"), [(B, 16), (D, 8), (C, 1), (A, 1)])
def test_a_schedule_opens_as_many_channels_as_its_broadcast(
    schedule: ScheduleName, width: int
) -> None:
    assert count_broadcast_channels(schedule, timing(16).muxes) == width
    check_broadcast_channels(schedule, timing(16).muxes, width)
    if width > 1:
        reason = f"{schedule!r} opens {width} channels at once.*at most {width - 1}.*pull-ups"
        with pytest.raises(SceneError, match=reason):
            check_broadcast_channels(schedule, timing(16).muxes, width - 1)
    uneven = [0x70, 0x71, 0x71, 0x71, 0x72]  # the fullest mux counts
    assert count_broadcast_channels(schedule, uneven) == {B: 5, D: 3}.get(schedule, 1)


# Choice


@pytest.mark.parametrize(
    ("tiles", "asked_hz", "channels_max", "schedule", "reason"),
    [
        (1, 0, 8, B, "1 tile on 1 mux: simultaneous gives 544 frames/s"),  # and has no skew
        (2, 0, 8, C, "2 tiles on 1 mux: pipelined gives 544 frames/s"),
        (8, 0, 8, C, "8 tiles on 1 mux: pipelined gives 435 frames/s"),
        (16, 0, 8, D, "16 tiles on 2 muxes: per_mux gives "),
        (64, 0, 8, D, "64 tiles on 8 muxes: per_mux gives "),
        (4, 390, 8, B, ""),  # 395 without skew is enough
        (4, 400, 8, C, ""),
        (4, 1000, 8, C, ""),  # no schedule is that fast
        (16, 100, 8, D, ""),
        (16, 100, 16, B, ""),
        (16, 0, 7, C, ""),
    ],
)
def test_the_fastest_allowed_schedule_or_one_without_skew_is_chosen(
    tiles: int, asked_hz: float, channels_max: int, schedule: ScheduleName, reason: str
) -> None:
    choice = choose_schedule(timing(tiles), requested_rate_hz=asked_hz, channels_max=channels_max)
    assert choice.schedule == schedule
    assert choice.reason.startswith(reason)
    if asked_hz == 390:
        assert "holds the 390 frames/s asked for" in choice.reason
    elif asked_hz == 0:
        for other in SCHEDULES:
            hz = round(1 / compute_frame_s(other, timing(tiles)))
            is_allowed = count_broadcast_channels(other, timing(tiles).muxes) <= channels_max
            assert (f"{other} {hz}" in choice.reason) == (is_allowed and other != schedule)


@settings(max_examples=60)
@given(
    tiles=st.integers(1, 64),
    scl_hz=st.sampled_from([100_000, 400_000]),
    channels_max=st.integers(1, 64),
)
def test_no_allowed_schedule_is_notably_faster_than_the_chosen_one(
    tiles: int, scl_hz: float, channels_max: int
) -> None:
    bus = timing(tiles, scl_hz)
    name = choose_schedule(bus, requested_rate_hz=0.0, channels_max=channels_max).schedule
    check_broadcast_channels(name, bus.muxes, channels_max)
    rates = compute_rates_hz(bus)
    allowed = [s for s in SCHEDULES if count_broadcast_channels(s, bus.muxes) <= channels_max]
    assert rates[name] >= 0.99 * max(rates[s] for s in allowed)
