"""The readings of one tile: jumps, stale readings."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import count, repeat

import numpy as np
import pytest

from devices.array.tile import TileHealth
from devices.flags import TileFlag
from devices.frames import NOT_READ
from tests.devices.rigs import ONE, Wires

MS = 1_000_000
COUNT_KPA = 0.1255  # the data sheet's part, hardware.md 1.3


def health() -> TileHealth:
    return TileHealth(Wires(ONE).infos[0])


def settled(pressure_raw: int = 410, temperature_raw: int = 507) -> TileHealth:
    tile = health()
    for _ in range(3):
        tile.accept_reading(pressure_raw, temperature_raw, 0)
    return tile


# Jumps


def test_every_reading_without_a_history_is_a_jump_and_none_is_a_far_one() -> None:
    tile = health()
    for _ in range(3):
        assert tile.is_jump(410, 507)
        assert not tile.is_far_jump(410, 507)
        tile.accept_reading(410, 507, 0)
    assert not tile.is_jump(410, 507)
    tile.mark_lost(0)
    tile.mark_present()
    assert tile.is_temperature_due(0)
    assert tile.is_jump(410, 507), "a tile that was lost has no history"


@pytest.mark.parametrize("sign", [-1, 1])
def test_half_a_kilopascal_and_a_kelvin_are_jumps_and_three_times_that_a_far_one(
    sign: int,
) -> None:
    tile = settled()
    near, far = int(0.5 / COUNT_KPA), int(1.5 / COUNT_KPA)
    assert not tile.is_jump(410 + sign * near, 507)
    assert tile.is_jump(410 + sign * (near + 1), 507)
    assert not tile.is_far_jump(410 + sign * far, 507)
    assert tile.is_far_jump(410 + sign * (far + 1), 507)
    # Five counts of temperature are a kelvin.
    assert not tile.is_jump(410, 507 + sign * 5)
    assert tile.is_jump(410, 507 + sign * 6)
    assert tile.is_far_jump(410, 507 + sign * 6)


def test_a_reading_without_temperature_is_compared_by_its_pressure() -> None:
    tile = settled()
    assert not tile.is_jump(410, NOT_READ)
    assert tile.is_jump(430, NOT_READ)
    tile.accept_reading(410, NOT_READ, 0)
    assert not tile.is_temperature_due(0), "it has the last one"
    assert health().is_temperature_due(0)


def test_one_accepted_outlier_does_not_change_the_median() -> None:
    tile = settled(410)
    tile.accept_reading(450, 507, 0)
    assert not tile.is_jump(410, 507)


def test_few_healthy_readings_are_jumps_and_hardly_any_is_a_far_one() -> None:
    # hardware.md 1.3: 0.165 kPa, 1.2 % more than 0.5 kPa off, none more than 1.2 kPa
    n, rng = 20_000, np.random.default_rng(1)
    kpa = 0.14 * rng.standard_normal(n)
    outliers = rng.random(n) < 0.012
    kpa[outliers] = rng.uniform(0.5, 1.2, outliers.sum()) * rng.choice([-1, 1], outliers.sum())
    pressure_raw = np.round(410 + kpa / COUNT_KPA).astype(int)
    temperature_raw = np.round(507.3 + 0.5 * rng.standard_normal(n)).astype(int)
    tile = settled()
    jumps = far = 0
    for counts in zip(pressure_raw.tolist(), temperature_raw.tolist(), strict=True):
        jumps += tile.is_jump(*counts)
        far += tile.is_far_jump(*counts)
        tile.accept_reading(*counts, 0)
    assert jumps / n < 0.03
    assert far < 4


# Stale readings


def count_readings_until_stale(tile: TileHealth, readings: Iterable[tuple[int, int]]) -> int:
    """Return the number of readings before the first stale one."""
    return next(n for n, counts in enumerate(readings) if tile.update_staleness(*counts))


def test_ten_equal_readings_or_twenty_without_temperature_are_stale() -> None:
    # The first of eleven is equal to none.
    tile = health()
    assert count_readings_until_stale(tile, repeat((410, 507))) == 10
    assert tile.update_staleness(410, 507)
    assert not tile.update_staleness(411, 507), "fresh at once"
    assert count_readings_until_stale(tile, repeat((411, 507))) == 9
    assert count_readings_until_stale(health(), repeat((410, NOT_READ))) == 20


@pytest.mark.parametrize(
    ("readings", "is_next_stale"),
    [
        ([(410 + frame % 2, 507) for frame in range(100)], False),
        ([(410, 507 + frame % 2) for frame in range(100)], False),
        ([(410, 507 + n // 4 % 2 if n % 4 == 0 else NOT_READ) for n in range(400)], False),
        ([(410, 507)] * 8 + [(NOT_READ, NOT_READ)] * 50 + [(410, 507)] * 2, True),
    ],
    ids=["pressure changes", "temperature changes", "the same, rarely read", "nothing is read"],
)
def test_a_reading_is_fresh_if_either_count_changes_and_frames_without_one_do_not_count(
    readings: list[tuple[int, int]], is_next_stale: bool
) -> None:
    tile = health()
    assert not any(tile.update_staleness(*counts) for counts in readings)
    assert tile.update_staleness(410, 507) == is_next_stale


def test_a_temperature_counts_in_the_frames_that_read_it() -> None:
    equal = ((410, 507 if frame % 4 == 0 else NOT_READ) for frame in count())
    assert 15 <= count_readings_until_stale(health(), equal) <= 17


def test_healthy_readings_are_hardly_ever_stale() -> None:
    n, rng = 200_000, np.random.default_rng(2)
    pressure_raw = np.round(410.2 + 1.3 * rng.standard_normal(n)).astype(int)
    temperature_raw = np.round(507.3 + 0.5 * rng.standard_normal(n)).astype(int)
    equal = (np.diff(pressure_raw) == 0) & (np.diff(temperature_raw) == 0)
    assert 0.05 < equal.mean() < 0.2
    tile = health()
    assert not any(map(tile.update_staleness, pressure_raw.tolist(), temperature_raw.tolist()))


# Presence


def test_a_lost_tile_is_looked_for_at_once_and_ever_more_rarely_until_it_returns() -> None:
    tile = settled()
    assert tile.is_present
    now_ns = 5 * MS
    tile.mark_lost(now_ns)
    assert not tile.is_present
    waits_ms = []
    for _ in range(14):
        asked_ns = now_ns
        while not tile.is_probe_due(now_ns):
            now_ns += MS // 2
        waits_ms.append((now_ns - asked_ns) / MS)
        tile.mark_lost(now_ns)
    assert waits_ms[:6] == [0, 2, 4, 8, 16, 32]
    assert waits_ms[-1] == waits_ms[-2] == 1000, "hardware.md 8: one tile a second"
    tile.mark_present()
    assert tile.is_present
    tile.mark_lost(now_ns)
    assert tile.is_probe_due(now_ns)


def test_faults_are_counted_by_reason() -> None:
    tile = health()
    tile.count_faults(TileFlag.NO_ANSWER)
    tile.count_faults(TileFlag.NO_ANSWER | TileFlag.RETRIED)
    assert tile.fault_counts == {"no_answer": 2, "retried": 1}


def test_half_as_far_is_a_jump_on_a_disturbed_line() -> None:
    tile = settled()
    near = 410 + 3  # of the example part's 0.1255 kPa: 0.38 kPa
    assert not tile.is_jump(near, 507)
    assert tile.is_jump(near, 507, is_strict=True)
    assert not tile.is_jump(410 + 1, 507, is_strict=True)
