"""Saturation: the chip's range by its reading, the calibrated one after the gas has cooled."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.arrays import Floats
from devices.chips.mpl115a2 import TADC_PER_KELVIN, Coefficients, compute_padc
from devices.errors import CalibrationError
from devices.flags import EstimateFlag
from service.estimation.effects import Effects, GasEffect, Parameter
from service.estimation.fitting.dome_model import DomeModel
from service.estimation.models.gas import GasParams, compute_isothermal_lower_bound_kpa
from service.estimation.pipeline.plan import EstimationPlan
from service.estimation.pipeline.saturation import is_after_long_gap, select_farther_bound
from service.estimation.records import Estimates, RecordArray
from tests.builders.arrays import COUNT_KPA, PERIOD_NS, UNLOADED_KPA, make_array
from tests.builders.calibrations import make_effects, newton_tile
from tests.builders.estimates import estimate, newton_plan, with_params
from tests.builders.frames import loaded_frames, make_frames

BASE_KPA = 100.0
FASTEST_GAS = GasParams.array(1, gamma=1.4, tau_s=10.0, wall_per_kpa=0.0, baseline_kpa=BASE_KPA)


def squeeze(force_n: Floats, gamma: float, tau_s: float, wall: float) -> tuple[Floats, Floats]:
    """Compute the readings of a dome of 32 N under a load every 2 ms, and with cooled gas."""
    model = DomeModel(np.array([22.0, 5.0, 5.0]), 16.0, BASE_KPA, wall, gamma=gamma, tau_s=tau_s)
    response = model.compute_response(0.002 * np.arange(len(force_n), dtype=np.float64), force_n)
    return response.kpa, response.isothermal_kpa


def bound_kpa(gas: RecordArray[GasParams], kpa: float) -> float:
    return float(compute_isothermal_lower_bound_kpa(gas[0], float(kpa)))


LOADS = st.lists(st.tuples(st.floats(0.0, 45.0), st.integers(1, 60)), min_size=1, max_size=12).map(
    lambda steps: np.interp(
        np.arange(sum(n for _, n in steps) + 1),
        np.cumsum([0, *(n for _, n in steps)]),
        [0.0, *(force for force, _ in steps)],
    )
)


@settings(max_examples=100, deadline=None)
@given(LOADS, st.floats(1.05, 1.4), st.floats(0.005, 0.06), st.floats(0.0, 0.0015))
def test_a_pressure_beyond_the_chips_end_settles_above_its_bound(
    force_n: Floats, gamma: float, tau_s: float, wall: float
) -> None:
    read_kpa, settled_kpa = squeeze(force_n, gamma, tau_s, wall)
    gas = GasParams.array(1, gamma=gamma, tau_s=tau_s, wall_per_kpa=wall, baseline_kpa=BASE_KPA)
    assert BASE_KPA < bound_kpa(gas, 115.0) < 115.0
    assert (settled_kpa[read_kpa > 115.0] > bound_kpa(gas, 115.0) - 0.02).all()


def test_the_fastest_squeeze_reaches_the_bound() -> None:
    force_n = np.concatenate([np.zeros(5), np.full(2, 30.0)])
    read_kpa, settled_kpa = squeeze(force_n, 1.4, 10.0, 0.0)
    assert settled_kpa[-1] == pytest.approx(bound_kpa(FASTEST_GAS, read_kpa[-1]), abs=0.01)


@pytest.mark.parametrize("kpa", [-20.0, 0.0, 60.0, BASE_KPA, np.nan])
def test_a_pressure_below_the_baseline_is_its_own_bound(kpa: float) -> None:
    assert bound_kpa(FASTEST_GAS, kpa) == pytest.approx(kpa, abs=0.0, nan_ok=True)


def test_the_farther_of_two_bounds_is_selected() -> None:
    assert [select_farther_bound(value, 0.0, 10.0) for value in (1.0, 9.0)] == [10.0, 0.0]


def test_a_gap_of_more_than_50_ms_is_long() -> None:
    assert [is_after_long_gap(t_ns, 1) for t_ns in (50_000_001, 50_000_002)] == [False, True]


# --- in an estimate -------------------------------------------------------------------------------

GAMMA, TAU_S = 1.3, 0.012


def effects_of_gas(gamma: float, tau_s: float) -> Effects:
    g, tau = (Parameter(value=value, sigma=0.0) for value in (gamma, tau_s))
    return make_effects(gas=GasEffect(gamma=g, tau_s=tau, misfit=0.1))


GAS = effects_of_gas(GAMMA, TAU_S)
NO_GAS = GAS.model_copy(update={"gas": None, "refused": {"gas": "not determined"}})
RANGE_KPA = 100 * COUNT_KPA
"""End of the calibrated range of the tiles below: 100 N, of 118 N within the chip's range."""


def compute_read_n(force_n: Floats) -> Floats:
    """Compute the apparent force on a tile of one newton a count, its gas heated by the squeeze."""
    wall, curve = GAS.wall_compliance_or_default_per_kpa, np.array([100.0, 0.0, 0.0])
    model = DomeModel(curve, RANGE_KPA, UNLOADED_KPA, wall, gamma=GAMMA, tau_s=TAU_S)
    t_s = 1e-9 * PERIOD_NS * np.arange(len(force_n), dtype=np.float64)
    return np.asarray((model.compute_response(t_s, force_n).kpa - UNLOADED_KPA) / COUNT_KPA)


def make_fast_load(peak_n: float) -> Floats:
    """Make a load that rises in 4 ms and lasts for 20 ms."""
    return np.interp(np.arange(200), [0, 20, 22, 32, 34, 199], [0, 0, peak_n, peak_n, 0, 0])


def plan_with(effects: tuple[Effects, ...], *models: str) -> EstimationPlan:
    info = make_array(len(effects))
    tiles = [
        newton_tile(serial, range_kpa=(0.0, RANGE_KPA), effects=each)
        for serial, each in zip(info.serials, effects, strict=True)
    ]
    return newton_plan(info, tiles=tiles, models=("unwrap", "gas", "static", *models))


def estimate_forces(forces_n: list[Floats], *effects: Effects) -> Estimates:
    return estimate(plan_with(effects), loaded_frames(np.stack(forces_n, axis=1)))


def test_a_fast_load_read_beyond_the_calibrated_range_is_not_saturated() -> None:
    true_n = make_fast_load(90.0)
    read_n = compute_read_n(true_n)
    assert 100.0 < read_n.max() < 118.0, "beyond the calibrated range, within the chip's"
    e = estimate_forces([read_n, read_n], GAS, GAS)
    assert not (e.estimate_flags & EstimateFlag.SATURATED).any()
    np.testing.assert_allclose(e.force_n[:, 0], true_n, atol=1.0)  # a count, and its heat
    assert np.isfinite(e.grf_sigma_n).all()


def test_a_load_beyond_the_chips_range_is_saturated_and_a_bound() -> None:
    true_n = make_fast_load(99.0)
    read_n = compute_read_n(true_n)
    hidden = np.rint(read_n) > 118.0
    assert hidden.any()
    e = estimate_forces([read_n, np.zeros(200)], GAS, GAS)
    assert ((e.estimate_flags & EstimateFlag.SATURATED) > 0)[hidden].all()
    bound_n = e.force_n[hidden, 0]
    assert (bound_n <= true_n[hidden]).all()
    assert (bound_n > 0.75 * true_n[hidden]).all(), "and not an idle one"
    assert np.isnan(e.force_sigma_n[hidden, 0]).all()


@pytest.mark.parametrize("warmer_k", [-6.0, 10.0])
def test_a_bound_is_valid_for_a_warmer_and_a_colder_dome(warmer_k: float) -> None:
    true_n, temperature_raw = 98.0, round(480 + warmer_k * TADC_PER_KELVIN)
    # A gas that hardly heats, so that the bound is near.
    plan = plan_with((effects_of_gas(1.02, 1.02),) * 2, "temperature")
    chip = Coefficients.from_words(plan.info.tiles[0].registers)
    # Slow, so that no heat of the squeeze is left; warmth acts on all of the gas.
    kpa = (UNLOADED_KPA + true_n * COUNT_KPA) * (1.0 + warmer_k * 0.3 / UNLOADED_KPA)
    pressure_raw = round(float(compute_padc(kpa, temperature_raw, chip)))
    read_kpa = chip.make_law().compute_kpa(pressure_raw, temperature_raw)
    plan = with_params(plan, chip_max_kpa=float(read_kpa) - 0.05)
    # So long after the first frame that the gas is as warm as the chip.
    t_mono_ns = 60_000_000_000 + PERIOD_NS * np.arange(20)
    t_mono_ns[0] = 0
    columns = {"pressure_raw": pressure_raw, "temperature_raw": temperature_raw}
    e = estimate(plan, make_frames(20, 2, t_mono_ns=t_mono_ns, **columns))
    assert ((e.estimate_flags & EstimateFlag.SATURATED) > 0).all()
    assert (e.force_n <= true_n).all()
    assert (e.force_n[1:] > 0.93 * true_n).all(), "and not an idle one"


def test_a_tile_without_a_gas_model_is_uncertain_alone() -> None:
    true_n = make_fast_load(60.0)
    e = estimate_forces([compute_read_n(true_n)] * 3, GAS, NO_GAS, GAS)
    off_n = np.abs(e.force_n - true_n[:, None])
    assert off_n[:, [0, 2]].max() < 1.5
    assert off_n[:, 1].max() > 10.0
    assert e.force_sigma_n[off_n[:, 1] > 3.0, 1].min() > 1.0
    assert (off_n <= 1.96 * e.force_sigma_n + 1.0).all()


def test_a_model_that_no_tile_offers_is_refused() -> None:
    with pytest.raises(CalibrationError, match="'gas' is not offered for tile T01: not determined"):
        plan_with((NO_GAS, NO_GAS))
