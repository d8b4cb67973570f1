"""What an estimate costs per frame, live and offline, beside the bare numpy of the same forces.

    .venv/bin/python benchmarks/estimate_speed.py

Four tiles. Bare numpy: compensation and cubic on the same rows, one sum, no uncertainty, no COP, no
contact, no flags. Medians of interleaved runs.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable

import numpy as np

from devices.frames import ArrayInfo, FrameBatch, TileInfo
from service.estimation.calibration import paper_eq2_shape
from service.estimation.estimate import EstimationState, finish, step
from service.estimation.plan import EstimationPlan, make_plan
from service.estimation.tare import Tare

TILES = 4
RUNS = 7
CHUNK = 4096
WORDS = (0x3ECE, 0xB3F9, 0xC517, 0x33C8)  # the data sheet's example part


def plan_of(models: tuple[str, ...]) -> EstimationPlan:
    """A plan for four tiles in a line."""
    tiles = tuple(
        TileInfo(
            serial=f"T{i}", mux=0x70, channel=i, coefficient_words=WORDS, x_m=0.014 * i, y_m=0.0,
            z_m=-0.15, reference=False, conversion_ms=1.6,
        )
        for i in range(TILES)
    )  # fmt: skip
    info = ArrayInfo(
        node="bench", boot_id="0", tiles=tiles, servo=None, schedule="simultaneous",
        nominal_rate_hz=395.0, utc_offset_ns=0, clock_set=True, software="bench", scene="bench",
        models=models,
    )  # fmt: skip
    baseline_kpa, noise_kpa = np.full(TILES, 100.0), np.full(TILES, 0.165)
    tadc = np.full(TILES, 480.0)
    tare = Tare(baseline_kpa, noise_kpa / 20, noise_kpa, tadc, 0, 0.0, 1.0, 400, "lead")
    return make_plan(info, paper_eq2_shape(), tare, models=models, lag_ms=10.0)


def frames_of(n: int) -> FrameBatch:
    """Frames with all tiles between no load and full load."""
    rng = np.random.default_rng(0)
    t_ns = np.arange(n, dtype=np.int64) * 2_532_500
    shape = (n, TILES)
    return FrameBatch(
        seq=np.arange(n, dtype=np.uint64),
        t_mono_ns=t_ns,
        t_ns=t_ns,
        padc=rng.integers(270, 380, shape).astype(np.uint16),
        tadc=rng.integers(500, 510, shape).astype(np.uint16),
        sample_offset_us=np.zeros(shape, np.int32),
        servo_counts=np.full(n, -(2**31), np.int32),
        servo_age_us=np.full(n, -1, np.int32),
        status=np.zeros(shape, np.uint8),
        frame_status=np.zeros(n, np.uint8),
        reference_force_n=np.full(n, np.nan, np.float32),
    )


def estimate(plan: EstimationPlan, frames: FrameBatch, batch: int) -> None:
    """All frames in batches."""
    state = EstimationState()
    for begin in range(0, len(frames), batch):
        _, state = step(plan, frames.rows(begin, min(begin + batch, len(frames))), state)
    finish(plan, state)


def bare(frames: FrameBatch, batch: int) -> None:
    """Counts to GRF in plain numpy."""
    for begin in range(0, len(frames), batch):
        p = frames.padc[begin : begin + batch].astype(np.float64)
        t = frames.tadc[begin : begin + batch].astype(np.float64)
        kpa = (2009.75 + (-2.3758 + 0.00079 * t) * p - 0.92047 * t) * (65 / 1023) + 50 - 100.0
        u = kpa / 15.0
        (41.45 * u * (0.5702 + u * (0.02354 + u * 0.13))).sum(axis=1)


def main() -> None:
    """Print the table."""
    both, static = plan_of(("unwrap", "static")), plan_of(("static",))
    print("| batch | frames | bare numpy ns | static ns | unwrap + static ns | ratio |")
    print("|--:|--:|--:|--:|--:|--:|")
    for batch, n in ((10, 10_000), (256, 100_000), (CHUNK, 1_000_000)):
        frames = frames_of(n)
        work: list[Callable[[], None]] = [
            lambda f=frames, b=batch: bare(f, b),
            lambda f=frames, b=batch: estimate(static, f, b),
            lambda f=frames, b=batch: estimate(both, f, b),
        ]
        times: list[list[float]] = [[], [], []]
        for _ in range(RUNS):
            for one, into in zip(work, times, strict=True):
                began = time.perf_counter()
                one()
                into.append((time.perf_counter() - began) / n * 1e9)
        a, b, c = (statistics.median(t) for t in times)
        print(f"| {batch} | {n} | {a:.0f} | {b:.0f} | {c:.0f} | {c / a:.1f} |")


if __name__ == "__main__":
    main()
