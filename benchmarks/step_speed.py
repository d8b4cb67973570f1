"""What a step of the live estimate costs, by ladder: CPU time of batches of ten and of long ones.

    .venv/bin/python benchmarks/step_speed.py [FRAMES]

A foot that comes and goes, with noise of a count, on emulated counts; best of seven turns. What a
ladder costs more than the one before it is the price of the models that it names more: one that is
not named is a branch that is not taken.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from devices.frames import FrameBatch
from service.estimation.estimate import ModelEstimator
from service.estimation.pipeline.plan import EstimationPlan

sys.path.insert(0, str(Path(__file__).parents[1]))

from tests.builders.arrays import array_at, make_servo
from tests.builders.calibrations import make_effects, newton_tile
from tests.builders.estimates import newton_plan
from tests.builders.frames import loaded_frames

RUNS, BATCH, CHUNK = 7, 10, 1024
LADDERS: Mapping[str, tuple[str, ...]] = {
    "static": ("static",),
    "with gas": ("static", "gas"),
    "with denoise": ("static", "denoise"),
    "whole": (
        *("unwrap", "temperature", "gas", "static", "skew", "denoise"),
        *("hysteresis", "rubber"),
    ),
}


def plan_of(models: tuple[str, ...], tiles: int) -> EstimationPlan:
    """A plan of that many tiles, eight in a line, each with all effects."""
    info = array_at(
        [(0.014 * (i % 8), 0.014 * (i // 8), -0.15) for i in range(tiles)], servo=make_servo()
    )
    known = [newton_tile(serial, effects=make_effects()) for serial in info.serials]
    return newton_plan(info, models=models, tiles=known, lag_ms=10.0)


def frames_of(n: int, tiles: int) -> FrameBatch:
    """Steps of 0.3 s, up to 60 N on each tile."""
    rng = np.random.default_rng(1)
    shape = np.maximum(0.0, np.sin(2.0 * np.pi * np.arange(n) / 270.0))
    loads_n = shape[:, None] * rng.uniform(5.0, 60.0, tiles)
    frames = loaded_frames(loads_n + rng.normal(0.0, 1.0, loads_n.shape))
    for column in vars(frames).values():
        column.setflags(write=False)  # as those of a message are; others are copied at each step
    return frames


def cpu_s(plan: EstimationPlan, frames: FrameBatch, batch: int) -> float:
    """CPU time of all frames, in steps of so many."""
    estimator, edges = ModelEstimator(plan), range(0, len(frames), batch)
    batches = [frames.slice_rows(begin, min(begin + batch, len(frames))) for begin in edges]
    began_s = time.process_time()
    for each in batches:
        estimator.process_frames(each)
    return time.process_time() - began_s


def main() -> None:
    """Print the table."""
    n = int(sys.argv[1]) if len(sys.argv) > 1 else 4 * CHUNK
    print(f"| tiles | ladder | us a step of {BATCH} | ns a frame, {CHUNK} a step |")
    print("|--:|---|--:|--:|")
    for tiles in (4, 64):
        frames = frames_of(n, tiles)
        plans = {name: plan_of(models, tiles) for name, models in LADDERS.items()}
        best_s = dict.fromkeys(((name, size) for name in plans for size in (BATCH, CHUNK)), np.inf)
        for _ in range(RUNS):
            for name, size in best_s:
                best_s[name, size] = min(best_s[name, size], cpu_s(plans[name], frames, size))
        for name in plans:
            step_us = 1e6 * best_s[name, BATCH] / -(-n // BATCH)
            frame_ns = 1e9 * best_s[name, CHUNK] / n
            print(f"| {tiles} | {name} | {step_us:.0f} | {frame_ns:.0f} |", flush=True)


if __name__ == "__main__":
    main()
