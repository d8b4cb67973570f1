"""Estimates after saturation and gaps: valid bounds, and valid intervals after them.

Domes have creep, loop and gas of their own, known exactly to the estimator, so that only the unseen
load and noise are uncertain.
"""

from __future__ import annotations

from functools import cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import pytest

from devices.arrays import Bools, Floats
from devices.flags import EstimateFlag, TileFlag
from devices.frames import FrameBatch
from service.estimation.effects import GasEffect, HysteresisEffect, Parameter, RubberEffect
from service.estimation.fitting.dome_model import DomeModel
from service.estimation.pipeline.params import MODEL_NAMES
from service.estimation.pipeline.plan import EstimationPlan, make_plan
from service.estimation.records import Estimates
from tests.builders.arrays import UNLOADED_KPA, make_array
from tests.builders.calibrations import make_calibration, make_effects, make_tare, newton_tile
from tests.builders.estimates import estimate
from tests.builders.frames import make_frames

STEP_S = 0.002
NOISE_KPA = 0.165
SCALE_KPA = 14.0
CURVE = (22.0, 5.0, 5.0)  # 32 N at the end of the calibrated range; the chip ends 1 kPa above it
CHIP_END_KPA = 115.0
DOMES = 40
LADDER = [name for name in MODEL_NAMES if name not in ("temperature", "ambient", "skew")]


class Run(NamedTuple):
    """A pressed dome: true force, frames in which its load was unseen, and its estimates."""

    true_n: Floats
    unseen: Bools
    estimates: Estimates

    def compute_since_s(self) -> Floats:
        """Compute the time since the last unseen frame; infinite before the first one."""
        rows = np.arange(len(self.unseen))
        last = np.maximum.accumulate(np.where(self.unseen, rows, -(10**9)))
        return np.where(last < 0, np.inf, (rows - last) * STEP_S)


def draw_load(rng: np.random.Generator) -> Floats:
    """Draw four stances with loads beyond the end, fast and slow, each with a second after it."""
    turns: list[tuple[float, float]] = [(0.3, 0.0)]  # seconds, and the load after them
    for _ in range(4):
        before_n = rng.uniform(0, 25)
        turns += [(rng.uniform(0.01, 0.1), before_n), (rng.uniform(0.02, 0.5), before_n)]
        peak_n = rng.uniform(36, 70)
        turns += [(rng.choice([0.004, 0.02, 0.1]), peak_n)]
        turns += [(rng.choice([0.002, 0.01, 0.1, 1.0]), peak_n)]
        after_n = rng.uniform(0, 25) * (rng.random() < 0.7)
        turns += [(rng.choice([0.004, 0.02, 0.1]), after_n), (1.0, after_n)]
    t_s = np.cumsum([0.0, *(seconds for seconds, _ in turns)])
    force_n = [0.0, *(load_n for _, load_n in turns)]
    return np.asarray(np.interp(np.arange(0.0, t_s[-1], STEP_S), t_s, force_n))


def draw_dome(rng: np.random.Generator, lag_ms: float) -> tuple[DomeModel, EstimationPlan]:
    def make_known(*values: float) -> tuple[Parameter, ...]:
        return tuple(Parameter(value=float(v), sigma=0.01 * float(v)) for v in values)

    gamma, tau_s = rng.uniform(1.1, 1.4), rng.uniform(0.005, 0.05)
    part, loop = rng.uniform(0.02, 0.06, 2), rng.uniform(0.0, 0.04, 3)
    creep_s = np.array([rng.uniform(0.02, 0.1), rng.uniform(0.5, 5.0)])
    effects = make_effects(
        gas=GasEffect(gamma=make_known(gamma)[0], tau_s=make_known(tau_s)[0], misfit=0.1),
        rubber=RubberEffect(
            part=make_known(*part),
            tau_s=make_known(*creep_s),
            coefficients=(0.0, *CURVE),
            covariance=((0.0,) * 3,) * 3,
            scatter=0.0,
            misfit=0.1,
            curve_misfit_n=0.0,
        ),
        hysteresis=HysteresisEffect(part=make_known(*loop)),
    )
    curve = {"coefficients": (0.0, *CURVE), "p_scale_kpa": SCALE_KPA, "range_kpa": (0.0, SCALE_KPA)}
    info = make_array(2)
    tiles = [newton_tile(serial, effects=effects, **curve) for serial in info.serials]
    tare = make_tare(2, noise_kpa=NOISE_KPA)
    plan = make_plan(info, make_calibration(*tiles), tare, models=LADDER, lag_ms=lag_ms)
    wall = effects.wall_compliance_or_default_per_kpa
    dome = DomeModel(
        np.array(CURVE), SCALE_KPA, UNLOADED_KPA, wall, gamma, tau_s, part, creep_s, loop
    )
    return dome, plan


def draw_frames(kpa: Floats, rng: np.random.Generator, away: Bools) -> FrameBatch:
    """Draw frames of two tiles: one reads these pressures in wrapped counts, one is unloaded."""
    both = np.stack([kpa, np.full(len(kpa), UNLOADED_KPA)], axis=1)
    noisy = both + rng.normal(0.0, NOISE_KPA, both.shape)
    pressure_raw = np.rint((1787 - (noisy - 50.0) * 1023 / 65) / 2) % 1024
    tile_flags = np.zeros(both.shape)
    tile_flags[away, 0] = TileFlag.NO_ANSWER
    return make_frames(len(kpa), 2, pressure_raw=pressure_raw, tile_flags=tile_flags)


KINDS = ("the counts wrap", "the chip stands still", "the tile does not answer")


@cache
def run_domes(kind: str, lag_ms: float) -> list[Run]:
    """Press domes with loads beyond the chip's end, or within the range of a silent tile."""
    runs = []
    for seed in range(DOMES):
        rng = np.random.default_rng(seed)
        dome, plan = draw_dome(rng, lag_ms)
        true_n = draw_load(rng)
        away = np.zeros(len(true_n), dtype=bool)
        if kind == "the tile does not answer":
            true_n = np.minimum(true_n, 25.0)
            for _ in range(4):
                begin = rng.integers(200, len(true_n) - 800)
                away[begin : begin + rng.choice([30, 100, 500])] = True
        kpa = dome.compute_response(STEP_S * np.arange(len(true_n), dtype=np.float64), true_n).kpa
        end_kpa = CHIP_END_KPA + 1.0 if kind == "the chip stands still" else np.inf
        e = estimate(plan, draw_frames(np.minimum(kpa, end_kpa), rng, away))
        saturated = (e.estimate_flags & EstimateFlag.SATURATED) > 0
        runs.append(Run(true_n, away if away.any() else saturated, e))
    return runs


@pytest.mark.slow
@pytest.mark.parametrize("lag_ms", [0.0, 10.0, 100.0])
@pytest.mark.parametrize("kind", KINDS)
def test_the_interval_after_an_unseen_load_covers_the_truth(kind: str, lag_ms: float) -> None:
    for begin_s, end_s in pairwise([0.0, 0.02, 0.05, *np.arange(1, 11) / 10]):
        covered = frames = 0
        for run in run_domes(kind, lag_ms):
            e, since_s = run.estimates, run.compute_since_s()
            off_n, sigma_n = np.abs(e.force_n[:, 0] - run.true_n), e.force_sigma_n[:, 0]
            stated = (since_s > begin_s) & (since_s <= end_s) & np.isfinite(sigma_n)
            covered += int((stated & (off_n <= 1.96 * sigma_n)).sum())
            frames += int(stated.sum())
        assert frames > 1000
        assert covered / frames >= 0.90, (begin_s, covered / frames)


@pytest.mark.parametrize("kind", KINDS[:2])
def test_a_saturated_force_is_a_valid_bound(kind: str) -> None:
    runs = run_domes(kind, 10.0)
    bound_n = np.concatenate([run.estimates.force_n[run.unseen, 0] for run in runs])
    true_n = np.concatenate([run.true_n[run.unseen] for run in runs])
    assert len(bound_n) > 5000
    assert (bound_n <= true_n).mean() >= 0.99
    assert np.median(bound_n) > 20.0, "and not an idle one"


@pytest.mark.parametrize("kind", KINDS)
def test_frames_after_an_unseen_load_are_flagged_until_it_is_below_the_noise(kind: str) -> None:
    first, late = [], []
    for run in run_domes(kind, 10.0):
        since_s = run.compute_since_s()
        flag = (run.estimates.estimate_flags & EstimateFlag.AFTER_SATURATION) > 0
        assert not flag[: np.argmax(run.unseen)].any()
        first.append(flag[~run.unseen & (since_s < 1.5 * STEP_S)])
        late.append(flag[~run.unseen & (since_s > 0.9) & (since_s < 1.0)])
        sigma_n = run.estimates.force_sigma_n[:, 0]
        assert np.nanmedian(sigma_n[flag]) > 1.5 * np.nanmedian(sigma_n[~flag])
    assert np.concatenate(first).mean() > 0.7
    assert np.concatenate(late).mean() < 0.1


@pytest.mark.parametrize(("frames", "flagged"), [(24, []), (26, [126])], ids=["48 ms", "52 ms"])
def test_a_load_is_unseen_after_50_ms_without_an_answer(frames: int, flagged: list[int]) -> None:
    rng = np.random.default_rng(5)
    _, plan = draw_dome(rng, 0.0)
    away = np.zeros(300, dtype=bool)
    away[100 : 100 + frames] = True
    e = estimate(plan, draw_frames(np.full(300, 110.0), rng, away))
    found = np.flatnonzero(e.estimate_flags & EstimateFlag.AFTER_SATURATION)
    assert found[:1].tolist() == flagged
