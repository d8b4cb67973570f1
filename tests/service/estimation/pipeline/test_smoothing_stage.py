"""`denoise` on a foot: what the sum of tiles shows bounds the windows of each of them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from devices.arrays import Floats
from devices.jit import jit_cached
from service.estimation.models import denoise
from service.estimation.pipeline.params import KernelParams, make_kernel_params
from service.estimation.pipeline.smoothing_stage import (
    TILE_FORCE,
    TileForce,
    denoise_forces_and_scale_noise,
)
from service.estimation.pipeline.state import FrameBuffer, make_frame_buffer
from service.estimation.records import RecordArray
from tests.builders.arrays import array_at
from tests.builders.estimates import newton_plan

SIGMA_N, PERIOD_NS, TILES = 0.3, 1_838_235, 4


def smooth(forces_n: Floats) -> Floats:
    """Averaged forces of tiles, (n, tiles), all sampled with their frame."""
    n, tiles = forces_n.shape
    info = array_at([(0.01 * j, 0.0, 0.0) for j in range(tiles)])
    params = make_kernel_params(
        newton_plan(info, models=("static", "skew", "denoise"), lag_ms=100.0)
    )
    buffer = make_frame_buffer(n, tiles)
    buffer.t_mono_ns[:] = PERIOD_NS * np.arange(n)
    buffer.sampled_ns[:] = buffer.t_mono_ns[:, None]
    buffer.usable_n[:, :tiles], buffer.noise_n[:, :tiles] = forces_n, SIGMA_N
    buffer.usable_n[:, tiles] = forces_n.sum(axis=1)
    buffer.noise_n[:, tiles] = tiles**0.5 * SIGMA_N
    out = np.full((n, tiles), math.nan)
    _average_all(params, buffer, out)
    return out


@jit_cached
def _average_all(params: KernelParams, buffer: FrameBuffer, out: Floats) -> None:
    forces: RecordArray[TileForce] = np.zeros(len(params.tiles), TILE_FORCE)
    rows, windows = (0, 0), denoise.allocate_scratch()
    for i in range(len(out)):
        rows = denoise.find_oldest_and_newest_window_rows(
            buffer.t_mono_ns, i, 0, len(out), rows, 100_000_000
        )
        for j in range(len(forces)):
            forces[j].force_n, forces[j].noise_n = buffer.usable_n[i, j], buffer.noise_n[i, j]
        denoise_forces_and_scale_noise(params, buffer, i, rows, windows, forces)
        for j in range(len(forces)):
            out[i, j] = forces[j].force_n


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
