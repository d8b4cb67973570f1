"""What a tile bore unseen: bounds that hold, and honest numbers after it.

Domes with creep, loop and gas of their own, known exactly to the estimator, so that nothing but
what was unseen is uncertain, beside noise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.arrays import Bools, Floats
from devices.flags import EstimateFlag, TileFlag
from devices.frames import FrameBatch
from service.estimation.effects import GasEffect, HysteresisEffect, Parameter, RubberEffect
from service.estimation.fitting.dome_model import DomeModel
from service.estimation.pipeline.model_set import MODEL_NAMES
from service.estimation.pipeline.plan import EstimationPlan, make_plan
from service.estimation.pipeline.saturation import is_after_long_gap, select_farther_bound
from service.estimation.records import Estimates
from tests.builders.arrays import UNLOADED_KPA, make_array
from tests.builders.calibrations import make_calibration, make_effects, make_tare, newton_tile
from tests.builders.estimates import estimate
from tests.builders.frames import assert_same_bits, make_frames

STEP_S = 0.002
NOISE_KPA = 0.165
SCALE_KPA = 14.0
CURVE = (22.0, 5.0, 5.0)  # 32 N at the end of the calibrated range; the chip ends 1 kPa above it
CHIP_END_KPA = 115.0
NOTHING = ((0.0,) * 3,) * 3
DOMES = 40
LADDER = [name for name in MODEL_NAMES if name not in ("temperature", "ambient", "skew")]


def known(*values: float) -> tuple[Parameter, ...]:
    return tuple(Parameter(value=float(value), sigma=0.01 * float(value)) for value in values)


@dataclass
class Run:
    """A dome that was pressed: true force, where its pressure was hidden, and its estimates."""

    true_n: Floats
    unseen: Bools
    estimates: Estimates

    @property
    def since_s(self) -> Floats:
        """Since when it is seen again; infinite before it ever was not."""
        rows = np.arange(len(self.unseen))
        last = np.maximum.accumulate(np.where(self.unseen, rows, -(10**9)))
        return np.where(last < 0, np.inf, (rows - last) * STEP_S)


def a_load(rng: np.random.Generator) -> Floats:
    """Four stances with loads beyond the end, fast and slow, short and long, each with a second
    of some other load or none behind it."""
    t_s, force_n = [0.0, 0.3], [0.0, 0.0]

    def to(load_n: float, in_s: float) -> None:
        t_s.append(t_s[-1] + in_s)
        force_n.append(load_n)

    for _ in range(4):
        before_n = rng.uniform(0, 25)
        to(before_n, rng.uniform(0.01, 0.1))
        to(before_n, rng.uniform(0.02, 0.5))
        peak_n = rng.uniform(36, 70)
        to(peak_n, rng.choice([0.004, 0.02, 0.1]))
        to(peak_n, rng.choice([0.002, 0.01, 0.1, 1.0]))
        after_n = rng.uniform(0, 25) * (rng.random() < 0.7)
        to(after_n, rng.choice([0.004, 0.02, 0.1]))
        to(after_n, 1.0)
    return np.asarray(np.interp(np.arange(0.0, t_s[-1], STEP_S), t_s, force_n))


def a_dome(rng: np.random.Generator, lag_ms: float) -> tuple[DomeModel, EstimationPlan]:
    gamma, tau_s = rng.uniform(1.1, 1.4), rng.uniform(0.005, 0.05)
    part, loop = rng.uniform(0.02, 0.06, 2), rng.uniform(0.0, 0.04, 3)
    creep_s = np.array([rng.uniform(0.02, 0.1), rng.uniform(0.5, 5.0)])
    effects = make_effects(
        gas=GasEffect(gamma=known(gamma)[0], tau_s=known(tau_s)[0], misfit=0.1),
        rubber=RubberEffect(
            part=known(*part),
            tau_s=known(*creep_s),
            coefficients=(0.0, *CURVE),
            covariance=NOTHING,
            scatter=0.0,
            misfit=0.1,
            curve_misfit_n=0.0,
        ),
        hysteresis=HysteresisEffect(part=known(*loop)),
    )
    info = make_array(2)
    tiles = [
        newton_tile(
            serial,
            p_scale_kpa=SCALE_KPA,
            coefficients=(0.0, *CURVE),
            range_kpa=(0.0, SCALE_KPA),
            effects=effects,
        )
        for serial in info.serials
    ]
    tare = make_tare(2, noise_kpa=NOISE_KPA)
    plan = make_plan(info, make_calibration(*tiles), tare, models=LADDER, lag_ms=lag_ms)
    wall = effects.wall_compliance_or_default_per_kpa
    dome = DomeModel(
        np.array(CURVE), SCALE_KPA, UNLOADED_KPA, wall, gamma, tau_s, part, creep_s, loop
    )
    return dome, plan


def read(kpa: Floats, rng: np.random.Generator, away: Bools | None = None) -> FrameBatch:
    """Frames of two tiles: one reads these pressures, with noise and whole counts, wrapped past
    the end; the other bears nothing."""
    both = np.stack([kpa, np.full(len(kpa), UNLOADED_KPA)], axis=1)
    noisy = both + rng.normal(0.0, NOISE_KPA, both.shape)
    pressure_raw = np.rint((1787 - (noisy - 50.0) * 1023 / 65) / 2) % 1024
    status = np.zeros(both.shape)
    if away is not None:
        status[away, 0] = TileFlag.NO_ANSWER
    return make_frames(len(kpa), 2, pressure_raw=pressure_raw, tile_flags=status)


def saturated_run(seed: int, *, lag_ms: float, stops_kpa: float = np.inf) -> Run:
    """Pressed beyond the end of the chip, which stands still at a pressure, or else wraps."""
    rng = np.random.default_rng(seed)
    dome, plan = a_dome(rng, lag_ms)
    true_n = a_load(rng)
    kpa = dome.compute_response(STEP_S * np.arange(len(true_n), dtype=np.float64), true_n).kpa
    e = estimate(plan, read(np.minimum(kpa, stops_kpa), rng))
    return Run(true_n, (e.estimate_flags & EstimateFlag.SATURATED) > 0, e)


def away_run(seed: int, *, lag_ms: float) -> Run:
    """Pressed within its range, while the tile does not answer now and then."""
    rng = np.random.default_rng(seed)
    dome, plan = a_dome(rng, lag_ms)
    true_n = np.minimum(a_load(rng), 25.0)
    kpa = dome.compute_response(STEP_S * np.arange(len(true_n), dtype=np.float64), true_n).kpa
    away = np.zeros(len(true_n), dtype=bool)
    for _ in range(4):
        begin = rng.integers(200, len(true_n) - 800)
        away[begin : begin + rng.choice([30, 100, 500])] = True
    return Run(true_n, away, estimate(plan, read(kpa, rng, away)))


RUNS: dict[str, Callable[[int, float], Run]] = {
    "the counts wrap": lambda seed, lag_ms: saturated_run(seed, lag_ms=lag_ms),
    "the chip stands still": lambda seed, lag_ms: saturated_run(
        seed, lag_ms=lag_ms, stops_kpa=CHIP_END_KPA + 1.0
    ),
    "the tile does not answer": lambda seed, lag_ms: away_run(seed, lag_ms=lag_ms),
}


@pytest.mark.parametrize("lag_ms", [0.0, 100.0])
@pytest.mark.parametrize("kind", RUNS)
def test_after_what_was_unseen_the_interval_covers_the_truth(kind: str, lag_ms: float) -> None:
    runs = [RUNS[kind](seed, lag_ms) for seed in range(DOMES)]
    edges_s = [0.0, 0.02, 0.05, *np.arange(1, 11) / 10]
    for begin_s, end_s in pairwise(edges_s):
        covered = frames = 0
        for run in runs:
            e, rows = run.estimates, (run.since_s > begin_s) & (run.since_s <= end_s)
            off_n = np.abs(e.force_n[:, 0] - run.true_n)
            stated = rows & np.isfinite(e.force_sigma_n[:, 0])
            covered += int((stated & (off_n <= 1.96 * e.force_sigma_n[:, 0])).sum())
            frames += int(stated.sum())
        assert frames > 1000
        assert covered / frames >= 0.90, (begin_s, covered / frames)


@pytest.mark.parametrize("kind", ["the counts wrap", "the chip stands still"])
def test_a_saturated_force_is_a_bound_that_holds(kind: str) -> None:
    runs = [RUNS[kind](seed, 10.0) for seed in range(DOMES)]
    bound_n = np.concatenate([run.estimates.force_n[run.unseen, 0] for run in runs])
    true_n = np.concatenate([run.true_n[run.unseen] for run in runs])
    assert len(bound_n) > 5000
    assert (bound_n <= true_n).mean() >= 0.99
    assert np.median(bound_n) > 20.0  # and not an idle one


@pytest.mark.parametrize("kind", RUNS)
def test_frames_after_it_are_flagged_until_it_is_below_the_noise(kind: str) -> None:
    first, late = [], []
    for seed in range(DOMES):
        run = RUNS[kind](seed, 10.0)
        flag = (run.estimates.estimate_flags & EstimateFlag.AFTER_SATURATION) > 0
        assert not flag[: np.argmax(run.unseen)].any()
        first.append(flag[~run.unseen & (run.since_s < 1.5 * STEP_S)])
        late.append(flag[~run.unseen & (run.since_s > 0.9) & (run.since_s < 1.0)])
        sigma_n = run.estimates.force_sigma_n[:, 0]
        assert np.nanmedian(sigma_n[flag]) > 1.5 * np.nanmedian(sigma_n[~flag])
    assert np.concatenate(first).mean() > 0.7
    assert np.concatenate(late).mean() < 0.1


def test_a_tile_that_is_away_for_some_frames_only_is_not_unseen() -> None:
    rng = np.random.default_rng(5)
    _, plan = a_dome(rng, 0.0)
    away = np.zeros(300, dtype=bool)
    away[100:124] = True  # 48 ms
    e = estimate(plan, read(np.full(300, 110.0), rng, away))
    assert not (e.estimate_flags & EstimateFlag.AFTER_SATURATION).any()
    away[100:126] = True
    e = estimate(plan, read(np.full(300, 110.0), rng, away))
    flag = (e.estimate_flags & EstimateFlag.AFTER_SATURATION) > 0
    assert np.flatnonzero(flag)[0] == 126


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    cuts=st.lists(st.integers(0, 1500), max_size=6),
    lag_ms=st.sampled_from([0.0, 10.0]),
)
def test_any_batches_give_the_same_bits_through_what_is_unseen(
    seed: int, cuts: list[int], lag_ms: float
) -> None:
    rng = np.random.default_rng(seed)
    dome, plan = a_dome(rng, lag_ms)
    true_n = a_load(rng)[:1500]
    kpa = dome.compute_response(STEP_S * np.arange(len(true_n), dtype=np.float64), true_n).kpa
    away = np.zeros(len(true_n), dtype=bool)
    begin = rng.integers(0, 1400)
    away[begin : begin + 60] = True
    frames = read(kpa, rng, away)
    edges = [0, *sorted(min(cut, len(frames)) for cut in cuts), len(frames)]
    pieces = [frames.slice_rows(*pair) for pair in pairwise(edges)]
    assert_same_bits(estimate(plan, frames), estimate(plan, *pieces))


def test_the_farthest_of_two_is_found_on_either_side() -> None:
    assert [select_farther_bound(of, 0.0, 10.0) for of in (1.0, 9.0)] == [10.0, 0.0]


def test_a_tile_was_away_if_more_than_50_ms_passed_between_its_readings() -> None:
    assert is_after_long_gap(50_000_002, 1)
    assert not is_after_long_gap(50_000_001, 1)
