"""Feet of four tiles, constant loads and random frames for the estimator."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from devices.frames import NO_SERVO_COUNTS, NOT_READ, FrameBatch
from service.estimation.pipeline.plan import EstimationPlan
from service.estimation.records import Estimates
from tests.builders.arrays import array_at
from tests.builders.estimates import estimate, newton_plan
from tests.builders.frames import loaded_frames, with_columns

SQUARE = [(0.0, 0.0, -0.15), (0.02, 0.0, -0.15), (0.0, 0.01, -0.15), (0.02, 0.01, -0.15)]

COP = ("cop_x_m", "cop_y_m", "cop_sigma_x_m", "cop_sigma_y_m", "cop_index_x", "cop_index_y")


def repeat_load(forces_n: Sequence[float], rows: int = 12) -> np.ndarray:
    """Repeat forces over frames, 2 ms each: with 12, contact is certain at the end."""
    return np.tile(np.array(forces_n, dtype=np.float64), (rows, 1))


def estimate_load(
    forces_n: Sequence[float], plan: EstimationPlan | None = None, **columns: Any
) -> Estimates:
    """Estimate 12 frames of a constant load, by default on a square of four tiles."""
    frames = loaded_frames(repeat_load(forces_n), **columns)
    return estimate(newton_plan(array_at(SQUARE)) if plan is None else plan, frames)


def draw_wild_frames(rows: int, tiles: int, seed: int) -> FrameBatch:
    """Draw loads that come and go, faults of every kind, gaps, servo drop-outs and old tares."""
    rng = np.random.default_rng(seed)
    on = np.repeat(rng.integers(0, 2, rows), rng.integers(1, 9, rows))[:rows]
    forces_n = on[:, None] * rng.integers(0, 70, tiles) + rng.normal(0, 1.5, (rows, tiles))
    forces_n[rng.random((rows, tiles)) < 0.03] = np.nan
    forces_n[rng.random((rows, tiles)) < 0.02] = rng.choice([130.0, 200.0, 499.0, 501.0, 510.0])
    frames = loaded_frames(forces_n)
    steps_ns = rng.choice([2_000_000] * 9 + [2_000_007, 900_000, 3_100_000, 60_000_000_000], rows)
    t_mono_ns = np.cumsum(steps_ns)
    # Readings 1 to 9 ms apart, each for several frames; some jump by more than half a turn.
    since_ns = np.cumsum(np.minimum(steps_ns, 4_000_000))
    sampled_ns = np.cumsum(rng.integers(1_000_000, 9_000_000, 4 * rows + 9)) - 9_000_000
    newest = np.clip(np.searchsorted(sampled_ns, since_ns) - 1, 0, None)
    counts = np.cumsum(rng.choice([-700, -1, 0, 3, 900, 3000], len(sampled_ns)))
    age_us = np.clip((since_ns - sampled_ns[newest]) // 1000, 0, None)
    tile_flags = frames.tile_flags | np.where(
        rng.random((rows, tiles)) < 0.05, 2 ** rng.integers(0, 6, (rows, tiles)), 0
    )
    return with_columns(
        frames,
        seq=np.cumsum(rng.choice([1] * 20 + [2, 900], rows)),
        t_mono_ns=t_mono_ns,
        temperature_raw=np.where(
            frames.temperature_raw == NOT_READ, NOT_READ, rng.integers(440, 560, (rows, tiles))
        ),
        tile_flags=tile_flags,
        frame_flags=np.where(rng.random(rows) < 0.1, rng.integers(0, 32, rows), 0),
        servo_counts=np.where(rng.random(rows) < 0.05, NO_SERVO_COUNTS, counts[newest]),
        servo_age_us=np.where(rng.random(rows) < 0.05, rng.integers(-1, 3000, rows), age_us),
        reference_force_n=rng.choice([np.nan, np.inf, 3.0], rows),
    )
