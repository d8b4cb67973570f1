"""`gas`: the pressure of a bubble whose gas has cooled."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.estimation.models import gas
from service.estimation.models.gas import RESTART_TIME_CONSTANTS, GasParams, GasState
from tests.builders.readings import through

GAMMA, TAU_S, WALL, BASE_KPA = 1.28, 0.011, 0.00124, 100.0


def settle(kpa: Any, t_s: Any, *, gamma: float = GAMMA, wall: float = WALL) -> np.ndarray:
    model = GasParams.array(1, gamma=gamma, tau_s=TAU_S, wall_per_kpa=wall, baseline_kpa=BASE_KPA)
    t_ns = np.rint(1e9 * np.asarray(t_s, dtype=float)).astype(np.int64)
    readings = np.asarray(kpa, dtype=float), t_ns, math.nan
    kernel = gas.compute_isothermal_pressure
    return through(kernel, model, GasState.array(1), *readings)


@given(cuts=st.lists(st.floats(0.001, 0.059), max_size=8), ratio=st.floats(0.8, 1.25))
def test_the_sampling_of_a_change_does_not_matter(cuts: list[float], ratio: float) -> None:
    # ln p linear over 60 ms, which is less than a restart
    t_s = np.array([0.0, *sorted({round(cut, 6) for cut in cuts}), 0.06])
    often = settle(100.0 * ratio ** (t_s / 0.06), t_s)
    once = settle([100.0, 100.0 * ratio], [0.0, 0.06])
    assert often[-1] == pytest.approx(once[-1], abs=1e-9)


def test_a_gas_restarts_in_equilibrium_after_a_gap_of_five_time_constants() -> None:
    longest_s = RESTART_TIME_CONSTANTS * GAMMA * TAU_S
    for gap_s, restarts in ((0.999 * longest_s, False), (1.001 * longest_s, True), (60.0, True)):
        out = settle([100.0, 100.0, 110.0], [0.0, 0.002, 0.002 + gap_s])
        assert (out[-1] == 110.0) == restarts


@pytest.mark.parametrize("invalid_kpa", [math.nan, math.inf, -math.inf, 0.0, -1.0])
def test_an_invalid_pressure_is_nan_and_changes_no_later_one(invalid_kpa: float) -> None:
    t_s, kpa = 0.002 * np.arange(9), 100.0 + 3.0 * np.arange(9)
    kpa[3] = invalid_kpa
    out = settle(kpa, t_s)
    assert np.flatnonzero(np.isnan(out)).tolist() == [3]
    rest = np.arange(9) != 3
    assert out[rest].tolist() == settle(kpa[rest], t_s[rest]).tolist()


@given(
    kpa=st.lists(st.floats(50.0, 180.0), min_size=1, max_size=40),
    step_s=st.sampled_from([0.0, 1e-9, 1e-6, 0.002, 0.07, 60.0]),
    gamma=st.floats(1.0, 1.6),
)
def test_the_correction_is_stable_for_any_step(
    kpa: list[float], step_s: float, gamma: float
) -> None:
    out = settle(kpa, step_s * np.arange(len(kpa)), gamma=gamma, wall=0.0)
    # Never warmer or colder than without any exchange from the least to the greatest pressure.
    most = (max(kpa) / min(kpa)) ** ((gamma - 1) / gamma)
    assert (out >= np.array(kpa) / most - 1e-9).all()
    assert (out <= np.array(kpa) * most + 1e-9).all()
