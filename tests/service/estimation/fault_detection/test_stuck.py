"""How often a healthy tile repeats itself, and when it does so too often."""

from __future__ import annotations

from typing import Annotated

import numpy as np
import numpy.typing as npt
import pytest
from scipy.signal import lfilter

from devices.arrays import Bools, Floats, Ints
from devices.jit import jit_cached
from service.estimation.fault_detection.stuck import (
    SHARE_STEPS,
    StuckLimits,
    StuckParams,
    StuckState,
    compute_step_share,
    initial_state,
    make_stuck_limits,
    update_stuck_and_toggles,
)
from service.estimation.records import KernelRecord, RecordArray

RATE_HZ = 447.0
COUNT_KPA = 0.15
UNLOADED = 4.0


def noise(n: int, tiles: int, counts: float, correlated_s: float = 0.0, seed: int = 0) -> Floats:
    """Gaussian noise of so many counts."""
    x = np.random.default_rng(seed).standard_normal((n, tiles))
    if correlated_s:
        kept = np.exp(-1.0 / (RATE_HZ * correlated_s))
        x = lfilter([np.sqrt(1.0 - kept**2)], [1.0, -kept], x, axis=0)
    return np.asarray(counts * x)


def limits_of(counts: float, tiles: int) -> StuckLimits:
    # What a tare finds: rounding is in it, and outliers.
    tared = 1.25 * np.hypot(counts, np.sqrt(1.0 / 12.0))
    return make_stuck_limits(np.full(tiles, tared), RATE_HZ)


class LimitTables(KernelRecord):
    """Limits of an array, as the parameters of a foot have them."""

    run_max_by_equal: Annotated[Ints, (SHARE_STEPS + 1,)]
    run_max_by_double_step: Annotated[Ints, (SHARE_STEPS + 1,)]


def judge(
    limits: StuckLimits,
    states: RecordArray[StuckState],
    pressure_raw: npt.NDArray[np.uint16],
    kpa: Floats,
    unloaded_kpa: float,
) -> npt.NDArray[np.bool_]:
    """Return which readings (n, tiles) are repeats that noise does not explain."""
    tables = LimitTables.array(
        1,
        run_max_by_equal=limits.run_max_by_equal,
        run_max_by_double_step=limits.run_max_by_double_step,
    )
    out = np.empty(kpa.shape, dtype=bool)
    counts = pressure_raw.astype(np.int64)
    _judge(tables, limits.to_records(), states, counts, kpa, unloaded_kpa, out)
    return out


@jit_cached
def _judge(
    limits: RecordArray[LimitTables],
    params: RecordArray[StuckParams],
    states: RecordArray[StuckState],
    pressure_raw: Ints,
    kpa: Floats,
    unloaded_kpa: float,
    out: Bools,
) -> None:
    n, tiles = kpa.shape
    toggles = 0
    for i in range(n):
        for j in range(tiles):
            out[i, j], toggles = update_stuck_and_toggles(
                limits[0], params[j], states[j], pressure_raw[i, j], kpa[i, j], unloaded_kpa,
                toggles, tiles,
            )  # fmt: skip


def found(level: Floats, counts: float, *, n_lead: int = 447) -> npt.NDArray[np.bool_]:
    """Judged readings of these levels in counts, after a second without load."""
    tiles = level.shape[1]
    lead = noise(n_lead, tiles, counts, seed=99)
    pressure_raw = np.rint(400.0 - np.concatenate([lead, level])).astype(np.uint16)
    kpa = COUNT_KPA * (400.0 - pressure_raw.astype(np.float64))
    unloaded_kpa = UNLOADED * COUNT_KPA * np.hypot(counts, 0.3)
    judged = judge(limits_of(counts, tiles), initial_state(tiles), pressure_raw, kpa, unloaded_kpa)
    assert not judged[:n_lead].any()
    return judged[n_lead:]


@pytest.mark.parametrize("counts", [0.05, 0.1, 0.2, 0.3, 0.5, 0.85, 1.3])
@pytest.mark.parametrize("correlated_s", [0.0, 0.01, 0.03])
def test_a_healthy_tile_is_not_called_stuck_wherever_between_two_counts_it_lies(
    counts: float, correlated_s: float
) -> None:
    # Eight places between two counts, learnt in one and judged in another, 13 minutes of tiles.
    n = 44_700
    level = noise(n, 8, counts, correlated_s) + np.linspace(0.0, 1.0, 8)
    level[n // 2 :] += 30.5
    assert not found(level, counts).any()


def test_a_tile_that_stands_still_is_found_within_a_tenth_of_a_second() -> None:
    level = noise(2000, 4, 0.85, seed=1)
    level[1000:, 2] = 30.0
    judged = found(level, 0.85)
    assert not judged[:, [0, 1, 3]].any()
    first = int(np.flatnonzero(judged[:, 2])[0])
    assert 1020 <= first < 1000 + 0.1 * RATE_HZ
    assert judged[first:, 2].all()


def test_one_that_moves_again_is_believed_at_once() -> None:
    level = noise(2000, 2, 0.85, seed=2)
    level[500:1000, 0] = 7.0
    judged = found(level, 0.85)
    assert judged[999, 0]
    assert not judged[1003:].any()


def test_a_quiet_tile_that_keeps_a_load_while_the_others_come_and_go_is_stuck() -> None:
    loads = np.where(np.arange(9000) // 300 % 2, 40.0, 0.0)[:, None]
    level = np.repeat(loads, 3, axis=1)
    level[450:, 1] = 40.0  # it never comes back
    judged = found(level, 0.0)
    assert not judged[:, [0, 2]].any()
    first = int(np.flatnonzero(judged[:, 1])[0])
    assert 450 + 2 * 5 * 300 - 300 <= first <= 450 + 2 * 5 * 300 + 300


def test_a_quiet_tile_that_bears_nothing_may_stand_still_for_ever() -> None:
    loads = np.where(np.arange(9000) // 300 % 2, 40.0, 0.0)[:, None]
    level = np.repeat(loads, 3, axis=1)
    level[:, 1] = 0.0
    assert not found(level, 0.0).any()


def test_readings_that_cannot_be_read_say_nothing() -> None:
    pressure_raw = np.full((500, 1), 65535, dtype=np.uint16)
    state = initial_state(1)
    judged = judge(limits_of(0.85, 1), state, pressure_raw, np.full((500, 1), np.nan), 1.0)
    assert not judged.any()
    assert state["unloaded_pairs"].tolist() == [0]


@pytest.mark.parametrize("step", [0.05, 0.3, 1.0, 3.0])
@pytest.mark.parametrize("counts", [0, 1, 2])
def test_shares_of_neighbours_are_what_rounding_makes_of_them(step: float, counts: int) -> None:
    rng = np.random.default_rng(5)
    begin = rng.uniform(0.0, 1.0, 400_000)
    moved = np.rint(begin + step * rng.standard_normal(len(begin))) - np.rint(begin)
    share = float(compute_step_share(np.array([step]), counts)[0])
    assert share == pytest.approx(float((np.abs(moved) == counts).mean()), abs=0.004)
