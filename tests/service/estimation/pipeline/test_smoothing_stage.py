"""`denoise` on a foot: the sum of tiles limits the windows of every tile."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from devices.arrays import Floats
from devices.jit import jit_cached
from service.estimation.models import denoise
from service.estimation.pipeline.params import KernelParams
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
    """Average forces of tiles, (n, tiles), all sampled with their frame."""
    n, tiles = forces_n.shape
    info = array_at([(0.01 * j, 0.0, 0.0) for j in range(tiles)])
    params = newton_plan(info, models=("static", "skew", "denoise"), lag_ms=100.0).params
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
    rows, windows = (0, 0), np.empty(denoise.SCRATCH_SHAPE)
    for i in range(len(out)):
        rows = denoise.find_oldest_and_newest_window_rows(
            buffer.t_mono_ns, i, len(out), rows, 100_000_000
        )
        for j in range(len(forces)):
            forces[j].force_n, forces[j].noise_n = buffer.usable_n[i, j], buffer.noise_n[i, j]
        denoise_forces_and_scale_noise(params, buffer, i, rows, windows, forces)
        for j in range(len(forces)):
            out[i, j] = forces[j].force_n


def add_noise(load_n: np.ndarray, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return load_n[:, None] + rng.normal(0.0, SIGMA_N, (len(load_n), TILES))


def smooth_apart(forces_n: np.ndarray) -> np.ndarray:
    """Average every tile as if it were alone."""
    return np.concatenate([smooth(column[:, None]) for column in forces_n.T], axis=1)


@pytest.mark.slow
def test_a_bend_below_a_tiles_noise_is_found_in_the_sum() -> None:
    # 25 ms of a load whose bend is below the noise of every tile.
    t_s = 1e-9 * PERIOD_NS * np.arange(400)
    load_n = 6.0 + 0.45 * np.sin(2 * math.pi * 35.0 * t_s)

    def compute_grf_error_n(smoothed: Callable[[Floats], Floats]) -> float:
        found = [smoothed(add_noise(load_n, seed)).sum(axis=1) for seed in range(10)]
        return float(np.sqrt(np.mean((np.array(found) - TILES * load_n) ** 2)))

    assert compute_grf_error_n(smooth) < 0.85 * compute_grf_error_n(smooth_apart)


def test_a_constant_load_has_little_more_noise() -> None:
    constant_n = np.full(400, 6.0)
    found = [[s(add_noise(constant_n, seed)) for s in (smooth, smooth_apart)] for seed in range(20)]
    off_n2 = np.mean((np.array(found) - 6.0) ** 2, axis=(0, 2, 3))
    assert off_n2[0] < 1.5 * off_n2[1]
    assert off_n2[0] < 0.2 * SIGMA_N**2


def test_a_load_that_moves_between_tiles_is_found_in_every_tile() -> None:
    # The sum is constant.
    step_n = np.where(np.arange(200) < 100, 0.0, 8.0)
    load_n = np.stack([step_n, 8.0 - step_n, step_n, 8.0 - step_n], axis=1)
    rng = np.random.default_rng(1)
    off_n = smooth(load_n + rng.normal(0.0, SIGMA_N, load_n.shape)) - load_n
    assert np.abs(off_n).max() < 5.5 * SIGMA_N


def test_tiles_beside_a_missing_one_are_averaged_apart() -> None:
    forces_n = add_noise(np.full(200, 6.0), 2)
    forces_n[50:60, 1] = math.nan
    out = smooth(forces_n)
    assert np.flatnonzero(np.isnan(out).any(axis=1)).tolist() == list(range(50, 60))
    silent = forces_n.copy()
    silent[:, 1] = math.nan
    others = [0, 2, 3]
    assert smooth(silent)[:, others].tolist() == smooth_apart(forces_n)[:, others].tolist()
