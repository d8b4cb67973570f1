"""Fault detection in an estimate: flags, forces and uncertainties, in any batches."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.arrays import Floats
from devices.chips.mpl115a2 import TADC_PER_KELVIN
from devices.flags import EstimateFlag
from devices.frames import FrameBatch
from service.estimation.pipeline.params import MODEL_NAMES
from service.estimation.pipeline.plan import EstimationPlan
from tests.builders.arrays import COUNT_KPA, PERIOD_NS, array_at
from tests.builders.calibrations import make_effects, newton_tile
from tests.builders.estimates import estimate, newton_plan
from tests.builders.frames import assert_same_bits, cut_up, loaded_frames
from tests.service.estimation.feet import SQUARE

RATE_HZ = 1e9 / PERIOD_NS
NO_AMBIENT = tuple(name for name in MODEL_NAMES if name != "ambient")
NOT_WARMED = tuple(name for name in NO_AMBIENT if name != "temperature")
FAULTS = EstimateFlag.STUCK | EstimateFlag.CLIPPED | EstimateFlag.BASELINE_LOST


def plan_with(*models: str, lag_ms: float = 10.0) -> EstimationPlan:
    info = array_at(SQUARE)
    tiles = [newton_tile(serial, effects=make_effects()) for serial in info.serials]
    return newton_plan(info, sigma_n=1.2, models=models, tiles=tiles, lag_ms=lag_ms)


def draw_forces(seconds: float, *, seed: int = 0) -> Floats:
    """Draw steps of 0.5 s, as long apart, of 40 to 60 N, with noise of a count."""
    t_s = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    rng = np.random.default_rng(seed)
    tops_n = rng.uniform(40.0, 60.0, (int(seconds) + 1, 4))[t_s.astype(int)]
    shape = np.where(t_s % 1.0 < 0.5, 0.0, np.sin(2 * np.pi * np.maximum(t_s % 1.0 - 0.5, 0.0)))
    return np.asarray(tops_n * shape[:, None] + rng.normal(0.0, 1.0, (len(t_s), 4)))


def frames_of(forces_n: Floats, **columns: object) -> FrameBatch:
    temperature_raw = np.rint(480 + np.random.default_rng(7).normal(0.0, 0.5, forces_n.shape))
    return loaded_frames(forces_n, **{"temperature_raw": temperature_raw} | columns)


each_ladder = pytest.mark.parametrize("models", [("unwrap", "static"), NO_AMBIENT, NOT_WARMED])


@each_ladder
def test_a_healthy_foot_has_no_fault_flag(models: tuple[str, ...]) -> None:
    flags = estimate(plan_with(*models), frames_of(draw_forces(30.0))).estimate_flags
    assert not (flags & FAULTS).any()


@each_ladder
def test_a_stuck_tile_is_missing_and_flagged(
    models: tuple[str, ...],
) -> None:
    forces_n = draw_forces(6.0)
    begin = round(3.7 * RATE_HZ)
    forces_n[begin : begin + round(RATE_HZ), 2] = forces_n[begin, 2]
    e = estimate(plan_with(*models), frames_of(forces_n))
    stuck = np.flatnonzero(e.estimate_flags & EstimateFlag.STUCK)
    assert 0.0 < stuck[0] / RATE_HZ - 3.7 < 0.1
    assert stuck[-1] / RATE_HZ == pytest.approx(4.7, abs=0.01)
    assert np.isnan(e.force_n[stuck, 2]).all()
    assert np.isnan(e.grf_n[stuck]).all()
    assert np.isfinite(e.force_n[stuck][:, [0, 1, 3]]).all()
    assert (e.estimate_flags[stuck] & EstimateFlag.TILE_MISSING).all()


@each_ladder
def test_clipped_forces_are_lower_bounds_and_flagged(
    models: tuple[str, ...],
) -> None:
    forces_n = draw_forces(20.0)
    noise_n = np.random.default_rng(1).normal(0.0, 1.0, len(forces_n))
    clipped_n = forces_n.copy()
    clipped_n[:, 1] = np.minimum(forces_n[:, 1], 30.0) + noise_n
    e = estimate(plan_with(*models), frames_of(clipped_n))
    clipped = np.flatnonzero(e.estimate_flags & EstimateFlag.CLIPPED)
    assert clipped[0] / RATE_HZ < 15.0
    assert (e.estimate_flags[clipped] & EstimateFlag.SATURATED).all()
    assert np.isnan(e.force_sigma_n[clipped, 1]).all()
    assert (e.force_n[clipped, 1] < 30.0).mean() > 0.99
    assert np.isnan(e.grf_sigma_n[clipped]).all()


def test_the_error_of_a_lost_baseline_is_in_sigma() -> None:
    forces_n = draw_forces(12.0)
    forces_n[round(5 * RATE_HZ) :, 3] -= 10.0
    e = estimate(plan_with("unwrap", "static"), frames_of(forces_n))
    lost = np.flatnonzero(e.estimate_flags & EstimateFlag.BASELINE_LOST)
    assert 0.3 < lost[0] / RATE_HZ - 5.0 < 0.6
    assert lost[-1] == len(forces_n) - 1  # until the next tare
    assert e.force_sigma_n[-1, 3] == pytest.approx(10.0, abs=1.5)
    assert e.force_sigma_n[-1, 0] < 2.0


@pytest.mark.parametrize("kelvin", [-4.0, 4.0])
def test_uncorrected_warmth_is_in_sigma_and_common_to_all_tiles(kelvin: float) -> None:
    forces_n = draw_forces(6.0)
    temperature_raw = frames_of(forces_n).temperature_raw.astype(np.float64)
    temperature_raw[round(3 * RATE_HZ) :] += round(TADC_PER_KELVIN * kelvin)
    frames = frames_of(forces_n, temperature_raw=temperature_raw)
    e = estimate(plan_with("unwrap", "static"), frames)
    expected_n = 0.3 * abs(kelvin) / COUNT_KPA
    assert e.force_sigma_n[-1] == pytest.approx([expected_n] * 4, rel=0.15)
    assert e.grf_sigma_n[-1] == pytest.approx(4 * expected_n, rel=0.15)
    lost_s = np.flatnonzero(e.estimate_flags & EstimateFlag.BASELINE_LOST) / RATE_HZ
    assert 0.0 < lost_s[0] - 3.0 < 0.5
    corrected = estimate(plan_with(*NO_AMBIENT), frames)
    assert corrected.force_sigma_n[-1].max() < 0.5 * expected_n


def test_a_stuck_bare_tile_gives_no_ambient_pressure() -> None:
    info = array_at(SQUARE, references=[3])
    tiles = [newton_tile(serial, effects=make_effects()) for serial in info.serials]
    plan = newton_plan(info, sigma_n=1.2, models=MODEL_NAMES, tiles=tiles)
    forces_n = draw_forces(4.0)
    forces_n[:, 3] = np.random.default_rng(2).normal(0.0, 1.0, len(forces_n))
    forces_n[round(2 * RATE_HZ) :, 3] = 0.0
    e = estimate(plan, frames_of(forces_n))
    assert e.estimate_flags[-1] & EstimateFlag.STUCK
    assert np.isnan(e.grf_n[-1])


def draw_faulty_frames(seed: int) -> FrameBatch:
    """Draw frames of a foot with every fault, and missing readings."""
    rng = np.random.default_rng(seed)
    forces_n = draw_forces(14.0, seed=seed)
    n = len(forces_n)
    forces_n[:, 0] = np.minimum(forces_n[:, 0], 30.0) + rng.normal(0.0, 1.0, n)
    begin = rng.integers(0, n - 500)
    forces_n[begin : begin + 300, 1] = forces_n[begin, 1]
    forces_n[rng.integers(n // 2, n) :, 2] -= 9.0
    forces_n[rng.random(forces_n.shape) < 0.01] = np.nan
    frames = frames_of(forces_n)
    temperature_raw = np.where(frames.temperature_raw < 1000, 480.0, frames.temperature_raw)
    temperature_raw[rng.integers(0, n) :, 3] += np.where(temperature_raw[0, 3] < 1000, 25, 0)
    return replace(
        frames,
        temperature_raw=np.where(np.isnan(forces_n), 65535, temperature_raw).astype(np.uint16),
    )


@each_ladder
@settings(max_examples=6, deadline=None)
@given(seed=st.integers(0, 20), cuts=st.lists(st.integers(1, 6999), max_size=30))
def test_any_batches_give_the_same_bits(
    models: tuple[str, ...], seed: int, cuts: list[int]
) -> None:
    plan, frames = plan_with(*models), draw_faulty_frames(seed)
    whole = estimate(plan, frames)
    assert (whole.estimate_flags & FAULTS).any()
    assert_same_bits(whole, estimate(plan, *cut_up(frames, cuts)))


def test_single_frames_give_the_same_bits() -> None:
    plan, frames = plan_with(*NO_AMBIENT), draw_faulty_frames(54)
    begin, end = 4200, 4760
    whole = estimate(plan, frames)
    assert not whole.estimate_flags[begin] & FAULTS
    assert np.bitwise_or.reduce(whole.estimate_flags[begin:end]) & FAULTS == FAULTS
    assert_same_bits(whole, estimate(plan, *cut_up(frames, range(begin, end))))
