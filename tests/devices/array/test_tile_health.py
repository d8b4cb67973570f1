"""What the words of one tile say of it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.array.tile import TileHealth, classify_impossible_counts
from devices.flags import TileFlag
from devices.frames import NOT_READ
from tests.builders.arrays import DATA_SHEET_CHIP
from tests.devices.rigs import ONE, Wires

MS = 1_000_000
COUNT_KPA = 0.1255  # the data sheet's part, hardware.md 1.3


def health() -> TileHealth:
    return TileHealth(Wires(ONE).infos[0])


def settled(pressure_raw: int = 410, temperature_raw: int = 507) -> TileHealth:
    one = health()
    for _ in range(3):
        one.accept_reading(pressure_raw, temperature_raw, 0)
    return one


# Words that no part gives


@pytest.mark.parametrize(
    ("words", "status"),
    [
        ((0, 0), TileFlag.NOT_CONVERTED),
        ((1023, 1023), TileFlag.IMPLAUSIBLE),
        ((500, 1023), TileFlag.IMPLAUSIBLE),
        ((500, 0), TileFlag.IMPLAUSIBLE),
        ((0, 500), 0),  # hardware.md 1.3: counts fall through zero
        ((1023, 500), 0),
        ((410, 507), 0),
        ((500, NOT_READ), 0),
        ((0, NOT_READ), 0),
    ],
)
def test_only_words_that_no_part_gives_are_impossible(words: tuple[int, int], status: int) -> None:
    assert classify_impossible_counts(*words) == status


# Jumps


def test_without_a_history_every_reading_is_looked_at_twice() -> None:
    one = health()
    for _ in range(3):
        assert one.is_jump(410, 507)
        assert not one.is_far_jump(410, 507), "there is nothing yet to be unlike"
        one.accept_reading(410, 507, 0)
    assert not one.is_jump(410, 507)


@pytest.mark.parametrize("sign", [-1, 1])
def test_half_a_kilopascal_is_a_jump_and_three_times_that_a_far_one(sign: int) -> None:
    one = settled()
    near, far = int(0.5 / COUNT_KPA), int(1.5 / COUNT_KPA)
    assert not one.is_jump(410 + sign * near, 507)
    assert one.is_jump(410 + sign * (near + 1), 507)
    assert not one.is_far_jump(410 + sign * far, 507)
    assert one.is_far_jump(410 + sign * (far + 1), 507)


@pytest.mark.parametrize("sign", [-1, 1])
def test_five_counts_of_temperature_are_a_kelvin_and_more_is_a_jump(sign: int) -> None:
    one = settled()
    assert not one.is_jump(410, 507 + sign * 5)
    assert one.is_jump(410, 507 + sign * 6)
    assert one.is_far_jump(410, 507 + sign * 6)


def test_a_reading_without_temperature_is_judged_by_its_pressure() -> None:
    one = settled()
    assert not one.is_jump(410, NOT_READ)
    assert one.is_jump(430, NOT_READ)
    one.accept_reading(410, NOT_READ, 0)
    assert not one.is_temperature_due(0), "it has that of before"
    assert health().is_temperature_due(0)


def test_one_outlier_that_was_believed_does_not_move_what_others_are_compared_with() -> None:
    one = settled(410)
    one.accept_reading(450, 507, 0)
    assert not one.is_jump(410, 507)


def test_what_is_lost_has_no_history_when_it_comes_back() -> None:
    one = settled()
    one.mark_lost(0)
    one.mark_present()
    assert one.is_temperature_due(0)
    assert one.is_jump(410, 507)


def test_of_healthy_readings_few_are_read_twice_and_none_is_far() -> None:
    # hardware.md 1.3: 0.165 kPa, 1.2 % more than 0.5 kPa off, none more than 1.2 kPa
    rng = np.random.default_rng(1)
    kpa = 0.14 * rng.standard_normal(50_000)
    outliers = rng.random(50_000) < 0.012
    kpa[outliers] = rng.uniform(0.5, 1.2, outliers.sum()) * rng.choice([-1, 1], outliers.sum())
    pressure_raw = np.round(410 + kpa / COUNT_KPA).astype(int)
    temperature_raw = np.round(507.3 + 0.5 * rng.standard_normal(50_000)).astype(int)
    one = settled()
    jumps = far = 0
    for words in zip(pressure_raw.tolist(), temperature_raw.tolist(), strict=True):
        jumps += one.is_jump(*words)
        far += one.is_far_jump(*words)
        one.accept_reading(*words, 0)
    assert jumps / 50_000 < 0.03
    assert far < 10


# Stale


def stale_after(one: TileHealth, words: tuple[int, int], tries: int = 100) -> int:
    return next(n for n in range(tries) if one.update_staleness(*words))


def test_ten_equal_readings_in_a_row_are_no_chance() -> None:
    # the first of eleven is equal to none
    assert stale_after(health(), (410, 507)) == 10


def test_of_pressure_alone_it_takes_twice_as_many() -> None:
    assert stale_after(health(), (410, NOT_READ)) == 20


def test_a_temperature_that_is_read_now_and_then_counts_when_it_is_read() -> None:
    one = health()
    words = [(410, 507 if frame % 4 == 0 else NOT_READ) for frame in range(40)]
    first = next(n for n, reading in enumerate(words) if one.update_staleness(*reading))
    assert 15 <= first <= 17
    other = health()
    changing = [(410, 507 + frame // 4 % 2 if frame % 4 == 0 else NOT_READ) for frame in range(400)]
    assert not any(other.update_staleness(*reading) for reading in changing)


@pytest.mark.parametrize("word", ["pressure_raw", "temperature_raw"])
def test_either_word_that_changes_is_a_sign_of_life(word: str) -> None:
    one = health()
    for frame in range(100):
        words = (410 + frame % 2, 507) if word == "pressure_raw" else (410, 507 + frame % 2)
        assert not one.update_staleness(*words)


def test_a_frame_without_a_reading_says_nothing_of_staleness() -> None:
    one = health()
    for _ in range(8):
        assert not one.update_staleness(410, 507)
    for _ in range(50):
        assert not one.update_staleness(NOT_READ, NOT_READ)
    assert stale_after(one, (410, 507)) == 2


def test_one_that_converts_again_is_fresh_at_once() -> None:
    one = health()
    stale_after(one, (410, 507))
    assert one.update_staleness(410, 507)
    assert not one.update_staleness(411, 507)
    assert stale_after(one, (411, 507)) == 9


def test_healthy_readings_are_stale_less_than_once_in_a_million() -> None:
    rng = np.random.default_rng(2)
    n = 1_000_000
    pressure_raw = np.round(410.2 + 1.3 * rng.standard_normal(n)).astype(int)
    temperature_raw = np.round(507.3 + 0.5 * rng.standard_normal(n)).astype(int)
    equal = (np.diff(pressure_raw) == 0) & (np.diff(temperature_raw) == 0)
    assert 0.05 < equal.mean() < 0.2
    one = health()
    assert not any(map(one.update_staleness, pressure_raw.tolist(), temperature_raw.tolist()))


# Presence


def test_a_tile_that_was_lost_is_looked_for_at_once_and_ever_more_rarely() -> None:
    one = settled()
    assert one.is_present
    now_ns = 5 * MS
    one.mark_lost(now_ns)
    assert not one.is_present
    waits_ms = []
    for _ in range(14):
        asked_ns = now_ns
        while not one.is_probe_due(now_ns):
            now_ns += MS // 2
        waits_ms.append((now_ns - asked_ns) / MS)
        one.mark_lost(now_ns)
    assert waits_ms[:6] == [0, 2, 4, 8, 16, 32]
    assert waits_ms[-1] == waits_ms[-2] == 1000, "hardware.md 8: one tile a second"


def test_a_tile_that_comes_back_is_lost_quickly_again() -> None:
    one = settled()
    for t_ns in range(10):
        one.mark_lost(t_ns)
    one.mark_present()
    assert one.is_present
    one.mark_lost(77 * MS)
    assert one.is_probe_due(77 * MS)


def test_what_went_wrong_is_counted_by_reason() -> None:
    one = health()
    one.count_faults(TileFlag.NO_ANSWER)
    one.count_faults(TileFlag.NO_ANSWER | TileFlag.RETRIED)
    assert one.fault_counts == {"no_answer": 2, "retried": 1}


def test_it_knows_the_bytes_that_its_coefficients_are() -> None:
    assert health().coefficient_words == DATA_SHEET_CHIP
    assert health().coefficient_bytes.hex() == "3eceb3f9c51733c8"


@settings(max_examples=50)
@given(pressure_raw=st.integers(0, 1023), temperature_raw=st.integers(1, 1022))
def test_a_reading_equal_to_those_before_never_jumps(
    pressure_raw: int, temperature_raw: int
) -> None:
    one = settled(pressure_raw, temperature_raw)
    assert not one.is_jump(pressure_raw, temperature_raw)
    assert not one.is_far_jump(pressure_raw, temperature_raw)


def test_on_a_disturbed_line_half_as_far_is_too_far() -> None:
    one = settled()
    near = 410 + 3  # of the example part's 0.1255 kPa: 0.38 kPa
    assert not one.is_jump(near, 507)
    assert one.is_jump(near, 507, is_strict=True)
    assert not one.is_jump(410 + 1, 507, is_strict=True)
