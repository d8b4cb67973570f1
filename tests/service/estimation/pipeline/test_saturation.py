"""What is saturated: the chip's range by what was read, the calibrated one behind the gas."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.arrays import Floats
from devices.chips.mpl115a2 import (
    TADC_PER_KELVIN,
    Coefficients,
    compensate_kpa,
    compute_padc,
)
from devices.errors import CalibrationError
from devices.flags import EstimateFlag
from service.estimation.calibration import TileCalibration
from service.estimation.effects import Effects, GasEffect, Parameter
from service.estimation.fitting.dome_model import DomeModel
from service.estimation.models.gas import GasModel, compute_isothermal_lower_bound_kpa
from service.estimation.records import Estimates
from tests.builders.arrays import COUNT_KPA, PERIOD_NS, UNLOADED_KPA, make_array
from tests.builders.calibrations import make_effects, newton_tile
from tests.builders.estimates import estimate, newton_plan
from tests.builders.frames import loaded_frames, make_frames

BASE_KPA, SCALE_KPA, STEP_S = 100.0, 16.0, 0.002
CURVE = np.array([22.0, 5.0, 5.0])  # newtons at the end of the range: 32


def squeezed(force_n: Floats, gamma: float, tau_s: float, wall: float) -> tuple[Floats, Floats]:
    """Pressures that are read under a load every 2 ms, and those that the gas would settle at."""
    model = DomeModel(CURVE, SCALE_KPA, BASE_KPA, wall, gamma=gamma, tau_s=tau_s)
    pressed = model.compute_response(STEP_S * np.arange(len(force_n), dtype=np.float64), force_n)
    return pressed.kpa, pressed.isothermal_kpa


loads = st.lists(st.tuples(st.floats(0.0, 45.0), st.integers(1, 60)), min_size=1, max_size=12).map(
    lambda steps: np.interp(
        np.arange(sum(n for _, n in steps) + 1),
        np.cumsum([0, *(n for _, n in steps)]),
        [0.0, *(force for force, _ in steps)],
    )
)


def at_least(gas: GasModel, kpa: float) -> float:
    return float(compute_isothermal_lower_bound_kpa(gas.to_records()[0], float(kpa)))


@settings(max_examples=200, deadline=None)
@given(loads, st.floats(1.05, 1.4), st.floats(0.005, 0.06), st.floats(0.0, 0.0015))
def test_what_is_hidden_behind_the_chips_end_settles_at_no_less_than_is_said(
    force_n: Floats, gamma: float, tau_s: float, wall: float
) -> None:
    read_kpa, settled_kpa = squeezed(force_n, gamma, tau_s, wall)
    gas = GasModel(np.array([gamma]), np.array([tau_s]), np.array([wall]), np.array([BASE_KPA]))
    bound_kpa = at_least(gas, 115.0)
    assert BASE_KPA < bound_kpa < 115.0
    assert (settled_kpa[read_kpa > 115.0] > bound_kpa - 0.02).all()


def test_the_bound_is_reached_by_the_fastest_squeeze() -> None:
    force_n = np.concatenate([np.zeros(5), np.full(2, 30.0)])
    read_kpa, settled_kpa = squeezed(force_n, 1.4, 10.0, 0.0)
    gas = GasModel(np.array([1.4]), np.array([10.0]), np.array([0.0]), np.array([BASE_KPA]))
    assert settled_kpa[-1] == pytest.approx(at_least(gas, read_kpa[-1]), abs=0.01)


@pytest.mark.parametrize("kpa", [-20.0, 0.0, 60.0, BASE_KPA])
def test_below_the_baseline_nothing_is_known_of_heat_that_has_gone_already(kpa: float) -> None:
    gas = GasModel(np.array([1.4]), np.array([10.0]), np.array([0.0]), np.array([BASE_KPA]))
    assert at_least(gas, kpa) == kpa
    assert np.isnan(at_least(gas, np.nan))


# --- in an estimate -------------------------------------------------------------------------------

GAMMA, TAU_S = 1.3, 0.012
GAS = make_effects(
    gas=GasEffect(
        gamma=Parameter(value=GAMMA, sigma=0.0), tau_s=Parameter(value=TAU_S, sigma=0.0), misfit=0.1
    )
)
NO_GAS = GAS.model_copy(update={"gas": None, "refused": {"gas": "not determined"}})
NEWTON_KPA = 100 * COUNT_KPA
"""End of the calibrated range of the tiles below: 100 N, of 118 that the chip can tell."""


def read_n(force_n: Floats) -> Floats:
    """What a tile of one newton a count seems to bear, its gas heated by being squeezed."""
    curve = np.array([100.0, 0.0, 0.0])
    wall = GAS.wall_compliance_or_default_per_kpa
    model = DomeModel(curve, NEWTON_KPA, UNLOADED_KPA, wall, gamma=GAMMA, tau_s=TAU_S)
    pressed = model.compute_response(
        1e-9 * PERIOD_NS * np.arange(len(force_n), dtype=np.float64), force_n
    )
    return np.asarray((pressed.kpa - UNLOADED_KPA) / COUNT_KPA)


def fast_load(peak_n: float) -> Floats:
    """Nothing, up in 4 ms, held for 20 ms, and long enough without load."""
    return np.interp(np.arange(200), [0, 20, 22, 32, 34, 199], [0, 0, peak_n, peak_n, 0, 0])


def tile(serial: str, effects: Effects = GAS) -> TileCalibration:
    return newton_tile(serial, range_kpa=(0.0, NEWTON_KPA), effects=effects)


def estimated(forces_n: Floats, effects: tuple[Effects, ...]) -> Estimates:
    info = make_array(forces_n.shape[1])
    tiles = [tile(serial, each) for serial, each in zip(info.serials, effects, strict=True)]
    plan = newton_plan(info, tiles=tiles, models=("unwrap", "gas", "static"))
    return estimate(plan, loaded_frames(forces_n))


def test_a_fast_load_that_reads_beyond_the_calibrated_range_is_not_saturated() -> None:
    true_n = fast_load(90.0)
    seen_n = read_n(true_n)
    assert 100.0 < seen_n.max() < 118.0  # beyond what was calibrated, within the chip's range
    e = estimated(np.stack([seen_n, seen_n], axis=1), (GAS, GAS))
    assert not (e.estimate_flags & EstimateFlag.SATURATED).any()
    np.testing.assert_allclose(e.force_n[:, 0], true_n, atol=1.0)  # a count, and what it heats
    assert np.isfinite(e.grf_sigma_n).all()


def test_what_the_chip_cannot_tell_is_saturated_whatever_the_gas_says_and_a_bound() -> None:
    true_n = fast_load(99.0)
    seen_n = read_n(true_n)
    hidden = np.rint(seen_n) > 118.0
    assert hidden.any()
    e = estimated(np.stack([seen_n, np.zeros(200)], axis=1), (GAS, GAS))
    saturated = (e.estimate_flags & EstimateFlag.SATURATED) > 0
    assert saturated[hidden].all()
    assert (e.force_n[hidden, 0] <= true_n[hidden]).all()
    assert (e.force_n[hidden, 0] > 0.75 * true_n[hidden]).all()  # and not an idle one
    assert np.isnan(e.force_sigma_n[hidden, 0]).all()


@pytest.mark.parametrize("warmer_k", [-6.0, 10.0])
def test_a_bound_holds_for_a_dome_that_is_warmer_or_colder_than_at_its_tare(
    warmer_k: float,
) -> None:
    """What warmth puts into the pressure is no load, also where only the chip's end is known."""
    info, true_n = make_array(2), 98.0
    warm_kpa = warmer_k * 0.3
    temperature_raw = round(480 + warmer_k * TADC_PER_KELVIN)
    chip = Coefficients.from_words(info.tiles[0].coefficient_words)
    # Slow, so that no heat of the squeeze is left; warmth acts on all of the gas.
    kpa = (UNLOADED_KPA + true_n * COUNT_KPA) * (1.0 + warm_kpa / UNLOADED_KPA)
    pressure_raw = round(float(compute_padc(kpa, temperature_raw, chip)))
    seen_kpa = float(
        compensate_kpa(pressure_raw, temperature_raw, chip.a0, chip.b1, chip.b2, chip.c12)
    )
    # A gas that hardly heats, so that the bound is near.
    gamma = Parameter(value=1.02, sigma=0.0)
    cool = GAS.model_copy(update={"gas": GasEffect(gamma=gamma, tau_s=gamma, misfit=0.1)})
    tiles = [tile(serial, cool) for serial in info.serials]
    plan = newton_plan(info, tiles=tiles, models=("unwrap", "temperature", "gas", "static"))
    plan = replace(plan, chip_max_kpa=np.full(2, seen_kpa - 0.05))  # ANY: fields of EstimationPlan
    # So long after the first frame that the gas is as warm as the chip.
    t_mono_ns = 60_000_000_000 + PERIOD_NS * np.arange(20)
    t_mono_ns[0] = 0
    e = estimate(
        plan,
        make_frames(
            20, 2, pressure_raw=pressure_raw, temperature_raw=temperature_raw, t_mono_ns=t_mono_ns
        ),
    )
    assert ((e.estimate_flags & EstimateFlag.SATURATED) > 0).all()
    assert (e.force_n <= true_n).all()
    assert (e.force_n[1:] > 0.93 * true_n).all()  # and not an idle one


def test_a_tile_without_gas_goes_without_alone_and_its_uncertainty_says_so() -> None:
    true_n = fast_load(60.0)
    seen_n = read_n(true_n)
    e = estimated(np.stack([seen_n] * 3, axis=1), (GAS, NO_GAS, GAS))
    off_n = np.abs(e.force_n - true_n[:, None])
    assert off_n[:, [0, 2]].max() < 1.5
    assert off_n[:, 1].max() > 10.0
    assert e.force_sigma_n[off_n[:, 1] > 3.0, 1].min() > 1.0
    assert (off_n <= 1.96 * e.force_sigma_n + 1.0).all()


def test_a_model_that_no_tile_offers_is_refused() -> None:
    with pytest.raises(CalibrationError, match="'gas' is not offered for tile T01: not determined"):
        estimated(np.zeros((5, 2)), (NO_GAS, NO_GAS))
