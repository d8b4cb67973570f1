"""How long a frame takes on the wire: the published tables, and the choice of a schedule.

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

NS = (1, 2, 4, 8, 16, 32, 64)


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
        bytes_read,
        transaction_us * 1e-6,
        sleep_us * 1e-6,
    )


A, B, C, D = SCHEDULES[3], SCHEDULES[0], SCHEDULES[1], SCHEDULES[2]
assert (A, B, C, D) == ("sequential", "simultaneous", "pipelined", "per_mux")

FAST: dict[tuple[ScheduleName, int], tuple[int | None, ...]] = {
    (A, 4): (544, 265, 132, 66, 33, 17, 8),
    (A, 2): (558, 271, 136, 68, 34, 17, 8),
    (B, 4): (544, 476, 395, 295, 192, 113, 62),
    (B, 2): (558, 497, 425, 330, 223, 135, 75),
    (C, 4): (544, 544, 544, 435, 213, 106, 53),
    (C, 2): (558, 558, 558, 515, 251, 126, 63),
    (D, 4): (None, None, None, None, 257, 129, 64),
    (D, 2): (None, None, None, None, 314, 158, 79),
}
SLOW: dict[tuple[ScheduleName, int], tuple[int | None, ...]] = {
    (A, 4): (392, 182, 91, 45, 23, 11, 6),
    (A, 2): (422, 195, 97, 49, 24, 12, 6),
    (B, 4): (392, 277, 188, 114, 62, 33, 17),
    (B, 2): (422, 308, 217, 136, 76, 40, 21),
    (C, 4): (392, 392, 217, 109, 53, 27, 13),
    (C, 2): (422, 422, 258, 129, 63, 31, 16),
    (D, 4): (None, None, None, None, 64, 32, 16),
    (D, 2): (None, None, None, None, 79, 39, 20),
}
# 60 us a transaction and 80 us of sleep overshoot: what Python on a Pi may reach
PYTHON: dict[tuple[ScheduleName, int], tuple[int | None, ...]] = {
    (A, 4): (491, 233, 116, 58, 29, 14, 7),
    (A, 2): (502, 238, 119, 59, 30, 15, 7),
    (B, 4): (491, 403, 317, 223, 135, 76, 40),
    (B, 2): (502, 418, 336, 242, 150, 85, 46),
    (C, 4): (491, 491, 491, 267, 130, 65, 32),
    (C, 2): (502, 502, 502, 296, 143, 72, 36),
    (D, 4): (None, None, None, None, 159, 80, 40),
    (D, 2): (None, None, None, None, 180, 90, 45),
}
LONGEST: dict[tuple[ScheduleName, int], tuple[int | None, ...]] = {
    (A, 4): (309, 152, 76, 38, 19, 9, 5),
    (B, 4): (309, 286, 254, 209, 151, 98, 57),
    (C, 4): (309, 309, 309, 309, 213, 106, 53),
}


def rows(
    table: dict[tuple[ScheduleName, int], tuple[int | None, ...]],
) -> list[tuple[ScheduleName, int, int, int]]:
    return [
        (name, n_bytes, n, hz)
        for (name, n_bytes), column in table.items()
        for n, hz in zip(NS, column, strict=True)
        if hz is not None
    ]


@pytest.mark.parametrize(("schedule", "n_bytes", "tiles", "hz"), rows(FAST))
def test_at_400_khz_the_rates_are_the_published_bounds(
    schedule: ScheduleName, n_bytes: int, tiles: int, hz: int
) -> None:
    assert round(1 / compute_frame_s(schedule, timing(tiles, bytes_read=n_bytes))) == hz


@pytest.mark.parametrize(("schedule", "n_bytes", "tiles", "hz"), rows(SLOW))
def test_at_100_khz_the_rates_are_the_published_bounds(
    schedule: ScheduleName, n_bytes: int, tiles: int, hz: int
) -> None:
    assert round(1 / compute_frame_s(schedule, timing(tiles, 100_000, bytes_read=n_bytes))) == hz


@pytest.mark.parametrize(("schedule", "n_bytes", "tiles", "hz"), rows(PYTHON))
def test_with_the_overhead_of_a_pi_the_rates_are_the_published_ones(
    schedule: ScheduleName, n_bytes: int, tiles: int, hz: int
) -> None:
    pi = timing(tiles, bytes_read=n_bytes, transaction_us=60, sleep_us=80)
    assert round(1 / compute_frame_s(schedule, pi)) == hz


@pytest.mark.parametrize(("schedule", "n_bytes", "tiles", "hz"), rows(LONGEST))
def test_with_the_longest_conversion_the_rates_are_the_published_ones(
    schedule: ScheduleName, n_bytes: int, tiles: int, hz: int
) -> None:
    assert round(1 / compute_frame_s(schedule, timing(tiles, bytes_read=n_bytes, tc_ms=3.0))) == hz


def test_four_tiles_at_400_khz_take_so_many_microseconds() -> None:
    # By hand from the bits: 20, 29 and 66 periods of 2.5 us, and 1.6 ms.
    expected_us = {
        "simultaneous": (4 * 20 + 29 + 4 * 66) * 2.5 + 1600,
        "pipelined": (29 + 66) * 2.5 + 1600,
        "per_mux": (4 * 20 + 29 + 4 * 66) * 2.5 + 1600,
        "sequential": 4 * ((20 + 29 + 66) * 2.5 + 1600),
    }
    found = compute_rates_hz(timing(4))
    assert {name: 1e6 / hz for name, hz in found.items()} == pytest.approx(expected_us)


def test_the_periods_of_a_read_are_those_of_the_data_sheets_figures() -> None:
    assert [count_read_bits(n) for n in (2, 4, 8)] == [48, 66, 102]


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


# How many channels at once


@pytest.mark.parametrize(
    ("schedule", "width"), [("simultaneous", 16), ("per_mux", 8), ("pipelined", 1), (A, 1)]
)
def test_a_schedule_opens_so_many_channels_at_once(schedule: ScheduleName, width: int) -> None:
    assert count_broadcast_channels(schedule, timing(16).muxes) == width


def test_per_mux_is_as_wide_as_its_fullest_mux() -> None:
    assert count_broadcast_channels("per_mux", [0x70, 0x71, 0x71, 0x71, 0x72]) == 3


def test_a_broadcast_that_the_wires_cannot_carry_is_refused_and_told_why() -> None:
    with pytest.raises(SceneError) as caught:
        check_broadcast_channels("simultaneous", timing(16).muxes, 8)
    text = str(caught.value)
    assert "'simultaneous' opens 16 channels at once" in text
    assert "at most 8" in text
    assert "pull-ups" in text
    assert caught.value.where == "array.broadcast_channels"
    assert "per_mux" in caught.value.remedy
    check_broadcast_channels("simultaneous", timing(16).muxes, 16)
    check_broadcast_channels("per_mux", timing(64).muxes, 8)
    check_broadcast_channels("pipelined", timing(64).muxes, 1)


# Which schedule


def best(tiles: int, *, asked_hz: float = 0.0, channels_max: int = 8) -> tuple[str, str]:
    choice = choose_schedule(timing(tiles), requested_rate_hz=asked_hz, channels_max=channels_max)
    return choice.schedule, choice.reason


@pytest.mark.parametrize("tiles", [2, 3, 4, 5, 6, 7, 8])
def test_up_to_eight_tiles_are_read_pipelined(tiles: int) -> None:
    schedule, reason = best(tiles)
    assert schedule == "pipelined"
    hz = round(1 / compute_frame_s("pipelined", timing(tiles)))
    assert reason.startswith(f"{tiles} tiles on 1 mux: pipelined gives {hz} frames/s")
    for other in ("simultaneous", "per_mux", "sequential"):
        assert f"{other} {round(1 / compute_frame_s(other, timing(tiles)))}" in reason


@pytest.mark.parametrize("tiles", [16, 24, 32, 48, 64])
def test_from_sixteen_tiles_on_mux_by_mux_is_best(tiles: int) -> None:
    schedule, reason = best(tiles)
    assert schedule == "per_mux"
    assert reason.startswith(f"{tiles} tiles on {tiles // 8} muxes: per_mux gives ")


def test_one_tile_is_as_fast_any_way_and_has_no_skew() -> None:
    schedule, reason = best(1)
    assert schedule == "simultaneous"
    assert reason.startswith("1 tile on 1 mux: simultaneous gives 544 frames/s")


def test_what_is_fast_enough_without_skew_is_taken_without_skew() -> None:
    assert best(4, asked_hz=390)[0] == "simultaneous"  # it gives 395
    assert "holds the 390 frames/s asked for" in best(4, asked_hz=390)[1]
    assert best(4, asked_hz=400)[0] == "pipelined"
    assert best(4, asked_hz=1000)[0] == "pipelined", "nothing holds it, so the fastest"


def test_a_schedule_that_opens_too_many_channels_is_not_chosen() -> None:
    assert best(16, asked_hz=100, channels_max=8)[0] == "per_mux"
    assert best(16, asked_hz=100, channels_max=16)[0] == "simultaneous"
    assert best(16, channels_max=7)[0] == "pipelined"
    assert "simultaneous" not in best(16, channels_max=8)[1]


@settings(max_examples=60)
@given(
    tiles=st.integers(1, 64),
    scl_hz=st.sampled_from([100_000, 400_000]),
    channels_max=st.integers(1, 64),
)
def test_what_is_chosen_is_allowed_and_nothing_allowed_is_notably_faster(
    tiles: int, scl_hz: float, channels_max: int
) -> None:
    bus = timing(tiles, scl_hz)
    name = choose_schedule(bus, requested_rate_hz=0.0, channels_max=channels_max).schedule
    check_broadcast_channels(name, bus.muxes, channels_max)
    rates = compute_rates_hz(bus)
    allowed = [s for s in SCHEDULES if count_broadcast_channels(s, bus.muxes) <= channels_max]
    assert rates[name] >= 0.99 * max(rates[s] for s in allowed)
