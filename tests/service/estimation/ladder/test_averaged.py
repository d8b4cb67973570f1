"""`denoise` on a foot: what the sum of tiles shows bounds the windows of each of them."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from service.estimation.ladder.averaged import averaged
from service.estimation.ladder.lower import ApparentForces
from service.estimation.models.denoise import AVERAGED_MAX

SIGMA_N, PERIOD_NS, TILES = 0.3, 1_838_235, 4


def plan(tiles: int) -> Any:
    """As much of one as averages need."""
    return SimpleNamespace(
        ladder=SimpleNamespace(skew=True),
        look_ns=100_000_000,
        waits=True,
        noise_left=np.ones((tiles, AVERAGED_MAX + 1)),
    )


def felt(forces_n: np.ndarray) -> ApparentForces:
    n, tiles = forces_n.shape
    nothing = np.zeros((n, tiles))
    t_ns = PERIOD_NS * np.arange(n)
    return ApparentForces(
        gauge_kpa=nothing,
        apparent_n=forces_n,
        noise_n=np.full((n, tiles), SIGMA_N),
        sigma_n=nothing,
        gas_n=nothing,
        unseen_gas_n=nothing,
        warm_n=nothing,
        sampled_ns=np.repeat(t_ns[:, None], tiles, axis=1),
        beyond=np.zeros((n, tiles), dtype=bool),
        guess_n=np.full((n, tiles), math.nan),
        t_mono_ns=t_ns,
        run=np.zeros(n, dtype=np.int64),
        status=np.zeros(n, dtype=np.uint16),
    )


def smooth(forces_n: np.ndarray) -> np.ndarray:
    n, tiles = forces_n.shape
    return averaged(plan(tiles), felt(forces_n), 0, n)[0]


def noisy(load_n: np.ndarray, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return load_n[:, None] + rng.normal(0.0, SIGMA_N, (len(load_n), TILES))


def one_by_one(forces_n: np.ndarray) -> np.ndarray:
    """Every tile as if there were no other."""
    return np.concatenate([smooth(column[:, None]) for column in forces_n.T], axis=1)


def test_a_load_that_lets_go_within_a_tiles_noise_is_seen_in_the_sum_of_all() -> None:
    # 25 ms of a load whose bend no tile can tell from its noise.
    t_s = 1e-9 * PERIOD_NS * np.arange(400)
    load_n = 6.0 + 0.45 * np.sin(2 * math.pi * 35.0 * t_s)

    def grf_off_n(smoothed: Any) -> float:
        found = [smoothed(noisy(load_n, seed)).sum(axis=1) for seed in range(20)]
        return float(np.sqrt(np.mean((np.array(found) - TILES * load_n) ** 2)))

    assert grf_off_n(smooth) < 0.85 * grf_off_n(one_by_one)


def test_a_still_load_costs_little_more_noise() -> None:
    still_n = np.full(400, 6.0)
    found = [[s(noisy(still_n, seed)) for s in (smooth, one_by_one)] for seed in range(20)]
    off_n2 = np.mean((np.array(found) - 6.0) ** 2, axis=(0, 2, 3))
    assert off_n2[0] < 1.5 * off_n2[1]
    assert off_n2[0] < 0.2 * SIGMA_N**2


def test_a_load_that_goes_from_tile_to_tile_is_judged_by_each_of_them() -> None:
    # In the sum nothing happens.
    step_n = np.where(np.arange(200) < 100, 0.0, 8.0)
    load_n = np.stack([step_n, 8.0 - step_n, step_n, 8.0 - step_n], axis=1)
    rng = np.random.default_rng(1)
    off_n = smooth(load_n + rng.normal(0.0, SIGMA_N, load_n.shape)) - load_n
    assert np.abs(off_n).max() < 5.5 * SIGMA_N


def test_where_a_tile_is_missing_the_others_are_averaged_on_their_own() -> None:
    forces_n = noisy(np.full(200, 6.0), 2)
    forces_n[50:60, 1] = math.nan
    out = smooth(forces_n)
    assert np.flatnonzero(np.isnan(out).any(axis=1)).tolist() == list(range(50, 60))
    silent = forces_n.copy()
    silent[:, 1] = math.nan
    others = [0, 2, 3]
    assert smooth(silent)[:, others].tolist() == one_by_one(forces_n)[:, others].tolist()


@pytest.mark.parametrize("first", [1, 37, 199])
def test_rows_are_the_same_whatever_else_is_asked_for(first: int) -> None:
    forces_n = noisy(np.where(np.arange(200) < 100, 6.0, 3.0), 3)
    whole = averaged(plan(TILES), felt(forces_n), 0, 200)
    parts = [averaged(plan(TILES), felt(forces_n), *rows) for rows in ((0, first), (first, 200))]
    for each, pieces in zip(whole, zip(*parts, strict=True), strict=True):
        assert np.concatenate(pieces).tobytes() == each.tobytes()
