"""Stuck tiles: equal counts in a row that noise does not explain."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from devices.arrays import Bools, Floats, Ints
from devices.jit import jit_cached
from service.estimation.fault_detection.stuck import (
    EqualCountLimits,
    StuckParams,
    StuckState,
    compute_step_share,
    make_stuck_params,
    update_stuck_and_load_changes,
)
from service.estimation.records import RecordArray
from tests.builders.noise import draw_lasting_noise

RATE_HZ = 447.0
COUNT_KPA = 0.15


def draw_noise(
    n: int, tiles: int, counts: float, correlated_s: float = 0.0, seed: int = 0
) -> Floats:
    """Draw noise of so many counts."""
    readings = max(RATE_HZ * correlated_s, 0.01)
    return counts * draw_lasting_noise(n, tiles, part=1.0, readings=readings, seed=seed)


def make_limits(
    counts: float, tiles: int
) -> tuple[RecordArray[StuckParams], RecordArray[EqualCountLimits]]:
    # The noise of a tare has rounding and outliers.
    tared = 1.25 * np.hypot(counts, np.sqrt(1.0 / 12.0))
    return make_stuck_params(np.full(tiles, tared), RATE_HZ)


def find_repeats(
    limits: tuple[RecordArray[StuckParams], RecordArray[EqualCountLimits]],
    states: RecordArray[StuckState],
    pressure_raw: npt.NDArray[np.uint16],
    kpa: Floats,
    unloaded_kpa: float,
) -> npt.NDArray[np.bool_]:
    """Find readings (n, tiles) that repeat more than noise explains."""
    params, tables = limits
    out = np.empty(kpa.shape, dtype=bool)
    counts = pressure_raw.astype(np.int64)
    _update_all(tables, params, states, counts, kpa, unloaded_kpa, out)
    return out


@jit_cached
def _update_all(
    limits: RecordArray[EqualCountLimits],
    params: RecordArray[StuckParams],
    states: RecordArray[StuckState],
    pressure_raw: Ints,
    kpa: Floats,
    unloaded_kpa: float,
    out: Bools,
) -> None:
    n, tiles = kpa.shape
    load_changes = 0
    for i in range(n):
        for j in range(tiles):
            out[i, j], load_changes = update_stuck_and_load_changes(
                limits[0], params[j], states[j], pressure_raw[i, j], kpa[i, j], unloaded_kpa,
                load_changes, tiles,
            )  # fmt: skip


def find_stuck(level: Floats, counts: float) -> npt.NDArray[np.bool_]:
    """Find stuck readings of these levels in counts, after a second without load."""
    tiles = level.shape[1]
    lead = draw_noise(447, tiles, counts, seed=99)
    pressure_raw = np.rint(400.0 - np.concatenate([lead, level])).astype(np.uint16)
    kpa = COUNT_KPA * (400.0 - pressure_raw.astype(np.float64))
    unloaded_kpa = 4.0 * COUNT_KPA * np.hypot(counts, 0.3)
    stuck = find_repeats(
        make_limits(counts, tiles), StuckState.array(tiles), pressure_raw, kpa, unloaded_kpa
    )
    assert not stuck[:447].any()
    return stuck[447:]


@pytest.mark.parametrize("counts", [0.05, 0.1, 0.2, 0.3, 0.5, 0.85, 1.3])
@pytest.mark.parametrize("correlated_s", [0.0, 0.03])
def test_a_healthy_tile_between_any_two_counts_is_not_stuck(
    counts: float, correlated_s: float
) -> None:
    # Eight places between two counts, learnt in one and checked in another, 13 minutes of tiles.
    n = 44_700
    level = draw_noise(n, 8, counts, correlated_s) + np.linspace(0.0, 1.0, 8)
    level[n // 2 :] += 30.5
    assert not find_stuck(level, counts).any()


def test_a_stuck_tile_is_found_within_a_tenth_of_a_second() -> None:
    level = draw_noise(2000, 4, 0.85, seed=1)
    level[1000:, 2] = 30.0
    stuck = find_stuck(level, 0.85)
    assert not stuck[:, [0, 1, 3]].any()
    first = int(np.flatnonzero(stuck[:, 2])[0])
    assert 1020 <= first < 1000 + 0.1 * RATE_HZ
    assert stuck[first:, 2].all()


def test_a_tile_that_moves_again_is_valid_at_once() -> None:
    level = draw_noise(2000, 2, 0.85, seed=2)
    level[500:1000, 0] = 7.0
    stuck = find_stuck(level, 0.85)
    assert stuck[999, 0]
    assert not stuck[1003:].any()


def test_a_quiet_tile_that_keeps_a_load_beside_changing_ones_is_stuck() -> None:
    loads = np.where(np.arange(9000) // 300 % 2, 40.0, 0.0)[:, None]
    level = np.repeat(loads, 3, axis=1)
    level[450:, 1] = 40.0  # it never comes back
    stuck = find_stuck(level, 0.0)
    assert not stuck[:, [0, 2]].any()
    first = int(np.flatnonzero(stuck[:, 1])[0])
    assert 450 + 2 * 5 * 300 - 300 <= first <= 450 + 2 * 5 * 300 + 300


def test_a_quiet_unloaded_tile_is_never_stuck() -> None:
    loads = np.where(np.arange(9000) // 300 % 2, 40.0, 0.0)[:, None]
    level = np.repeat(loads, 3, axis=1)
    level[:, 1] = 0.0
    assert not find_stuck(level, 0.0).any()


def test_unreadable_counts_are_not_stuck() -> None:
    pressure_raw = np.full((500, 1), 65535, dtype=np.uint16)
    state = StuckState.array(1)
    stuck = find_repeats(make_limits(0.85, 1), state, pressure_raw, np.full((500, 1), np.nan), 1.0)
    assert not stuck.any()
    assert state["unloaded_pairs"].tolist() == [0]


@pytest.mark.parametrize("step", [0.05, 0.3, 1.0, 3.0])
@pytest.mark.parametrize("counts", [0, 1, 2])
def test_the_share_of_a_step_follows_from_rounding(step: float, counts: int) -> None:
    rng = np.random.default_rng(5)
    begin = rng.uniform(0.0, 1.0, 400_000)
    moved = np.rint(begin + step * rng.standard_normal(len(begin))) - np.rint(begin)
    share = float(compute_step_share(np.array([step]), counts)[0])
    assert share == pytest.approx(float((np.abs(moved) == counts).mean()), abs=0.004)
