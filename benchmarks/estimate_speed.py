"""What an estimate costs per frame, live and offline, beside the bare numpy of the same forces.

    .venv/bin/python benchmarks/estimate_speed.py

Two tables, medians of interleaved runs. The first, with four tiles, is beside the least there could
be: compensation and cubic on the same rows, one sum, no uncertainty, no COP, no contact, no flags.
The second, with 4 and 64 tiles, is beside the same arithmetic written by hand with buffers that are
kept (static_kernel.py); that both give the same forces and centres is checked first. The goal is
within twice.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from static_kernel import StaticKernel

from devices.frames import FrameBatch
from service.estimation.calibration import make_paper_shape_preset
from service.estimation.estimate import ModelEstimator
from service.estimation.pipeline.plan import EstimationPlan, make_plan

sys.path.insert(0, str(Path(__file__).parents[1]))

from functools import partial

from tests.builders.arrays import DATA_SHEET_CHIP, make_array, make_tile
from tests.builders.calibrations import make_tare
from tests.builders.frames import make_frames

GOAL = 2.0
RUNS = 7
CHUNK = 1024


def plan_of(models: tuple[str, ...], count: int = 4) -> EstimationPlan:
    """A plan for that many tiles, at most eight in a line."""
    info = make_array(
        [
            make_tile(i, registers=DATA_SHEET_CHIP, x_m=0.014 * (i % 8), y_m=0.014 * (i // 8))
            for i in range(count)
        ],
        models=models,
    )
    tare = make_tare(
        count, baseline_kpa=100.0, baseline_sigma_kpa=0.165 / 20, noise_kpa=0.165, t_ns=0
    )
    return make_plan(info, make_paper_shape_preset(), tare, models=models, lag_ms=10.0)


def frames_of(n: int, count: int = 4) -> FrameBatch:
    """Frames with all tiles between no load and full load, a step a second."""
    rng = np.random.default_rng(0)
    shape = (n, count)
    turn = 2 * np.pi * 2.5325e-3 * np.arange(n)
    load = 55 - 55 * np.cos(turn[:, None] + np.linspace(0.0, 1.0, count))
    frames = make_frames(
        n,
        count,
        period_ns=2_532_500,
        utc_offset_ns=0,
        pressure_raw=np.round(380 - load + rng.normal(0.0, 0.7, shape)).astype(np.int64),
        temperature_raw=rng.integers(500, 510, shape),
    )
    for column in vars(frames).values():
        column.setflags(write=False)  # as those of a message are
    return frames


def estimate(plan: EstimationPlan, frames: FrameBatch, batch: int) -> None:
    """All frames in batches."""
    estimator = ModelEstimator(plan)
    for begin in range(0, len(frames), batch):
        estimator.process_frames(frames.slice_rows(begin, min(begin + batch, len(frames))))
    estimator.finish()


def bare(frames: FrameBatch, batch: int) -> None:
    """Counts to GRF in plain numpy."""
    for begin in range(0, len(frames), batch):
        p = frames.pressure_raw[begin : begin + batch].astype(np.float64)
        t = frames.temperature_raw[begin : begin + batch].astype(np.float64)
        kpa = (2009.75 + (-2.3758 + 0.00079 * t) * p - 0.92047 * t) * (65 / 1023) + 50 - 100.0
        u = kpa / 15.0
        (41.45 * u * (0.5702 + u * (0.02354 + u * 0.13))).sum(axis=1)


def by_hand(kernel: StaticKernel, frames: FrameBatch, batch: int) -> None:
    """All frames in batches through the hand-written kernel."""
    for begin in range(0, len(frames), batch):
        kernel(frames.slice_rows(begin, min(begin + batch, len(frames))))


def check_same(plan: EstimationPlan, frames: FrameBatch) -> None:
    """The kernel does the same job, or a comparison of times means nothing."""
    theirs = StaticKernel(plan, len(frames))(frames)
    estimator = ModelEstimator(plan)
    first, last = estimator.process_frames(frames), estimator.finish()
    assert last is not None
    for name, values in theirs.items():
        # What warmth and late instants may have done to a force is in our sigma only, and masks
        # centres that the kernel shows.
        if "sigma" in name:
            continue
        mine = np.concatenate([getattr(first, name), getattr(last, name)])
        both = np.isfinite(mine) & np.isfinite(values)
        assert both.mean() > (0.3 if name.startswith("cop") else 0.9), name
        np.testing.assert_allclose(values[both], mine[both], rtol=1e-9, atol=1e-9, err_msg=name)


def interleaved(work: Sequence[Callable[[], None]], n: int) -> list[float]:
    """Median ns per frame of each, taking turns; the first turn is not counted."""
    times: list[list[float]] = [[] for _ in work]
    for run in range(RUNS + 1):
        for one, into in zip(work, times, strict=True):
            began = time.perf_counter()
            one()
            if run:
                into.append((time.perf_counter() - began) / n * 1e9)
    return [statistics.median(t) for t in times]


def main() -> None:
    """Print the tables."""
    both, static = plan_of(("unwrap", "static")), plan_of(("static",))
    print("| batch | frames | bare numpy ns | static ns | unwrap + static ns | ratio |")
    print("|--:|--:|--:|--:|--:|--:|")
    for batch, n in ((10, 10_000), (256, 100_000), (CHUNK, 1_000_000)):
        frames = frames_of(n)
        a, b, c = interleaved(
            [
                partial(bare, frames, batch),
                partial(estimate, static, frames, batch),
                partial(estimate, both, frames, batch),
            ],
            n,
        )
        print(f"| {batch} | {n} | {a:.0f} | {b:.0f} | {c:.0f} | {c / a:.1f} |", flush=True)
    print()
    print(f"| tiles | batch | frames | by hand ns | static ns | ratio (goal: {GOAL:g}) |")
    print("|--:|--:|--:|--:|--:|--:|")
    for tiles, batch, n in (
        *((4, 10, 10_000), (4, CHUNK, 500_000)),
        *((64, 10, 10_000), (64, CHUNK, 50_000)),
    ):
        plan, frames = plan_of(("static",), tiles), frames_of(n, tiles)
        check_same(plan, frames.slice_rows(0, 1000))
        kernel = StaticKernel(plan, batch)
        a, b = interleaved(
            [
                partial(by_hand, kernel, frames, batch),
                partial(estimate, plan, frames, batch),
            ],
            n,
        )
        print(f"| {tiles} | {batch} | {n} | {a:.0f} | {b:.0f} | {b / a:.2f} |", flush=True)


if __name__ == "__main__":
    main()
