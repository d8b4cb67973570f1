"""`gas`: what a bubble would read if its gas had cooled, by closed forms."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.estimation.models import gas
from service.estimation.models.gas import RESTART_TIME_CONSTANTS, GasModel
from tests.builders.readings import through

GAMMA, TAU_S, WALL, BASE_KPA = 1.28, 0.011, 0.00124, 100.0
K = (GAMMA - 1.0) / GAMMA
GAMMA_TAU_S = GAMMA * TAU_S


def settled(kpa: Any, t_s: Any, *, gamma: float = GAMMA, wall: float = WALL) -> np.ndarray:
    model = GasModel(*(np.array([x]) for x in (gamma, TAU_S, wall, BASE_KPA)))
    t_ns = np.rint(1e9 * np.asarray(t_s, dtype=float)).astype(np.int64)
    kpa = np.asarray(kpa, dtype=float)
    return through(
        gas.compute_isothermal_pressure,
        model.to_records(),
        gas.initial_state(1),
        kpa,
        t_ns,
        math.nan,
    )


def given_way(kpa: Any, warm: Any) -> Any:
    """What a pressure settles at if its gas is `warm` times as warm as its wall."""
    iso = np.asarray(kpa) / warm
    return iso * (1 + WALL * (kpa - BASE_KPA)) / (1 + WALL * (iso - BASE_KPA))


def test_a_pressure_that_lasts_is_left_as_it_is() -> None:
    assert settled([107.3] * 50, 0.002 * np.arange(50)).tolist() == [107.3] * 50


def test_a_squeeze_at_once_warms_the_gas_and_it_cools_with_gamma_tau() -> None:
    t_s = 1.0 + 0.002 * np.arange(20)
    kpa = [100.0, *[112.0] * 20]
    warm = 1 + ((112 / 100) ** K - 1) * np.exp(-(t_s - 1.0) / GAMMA_TAU_S)
    assert settled(kpa, [1.0, *t_s])[1:] == pytest.approx(given_way(112.0, warm), abs=1e-9)


def test_under_pressure_that_grows_by_the_same_part_every_second_the_gas_keeps_its_warmth() -> None:
    # gamma dT/dt = 0: T = 1/(1 - (gamma - 1) tau d(ln p)/dt)
    t_s, rate = 0.002 * np.arange(200), 0.7
    kpa = 95.0 * np.exp(rate * t_s)
    warm = 1 / (1 - (GAMMA - 1) * TAU_S * rate)
    assert settled(kpa, t_s)[-1] == pytest.approx(given_way(kpa[-1], warm), abs=1e-9)


@given(cuts=st.lists(st.floats(0.001, 0.059), max_size=8), ratio=st.floats(0.8, 1.25))
def test_how_often_a_change_was_sampled_does_not_matter(cuts: list[float], ratio: float) -> None:
    # ln p linear over 60 ms, which is less than a restart
    t_s = np.array([0.0, *sorted({round(cut, 6) for cut in cuts}), 0.06])
    often = settled(100.0 * ratio ** (t_s / 0.06), t_s)
    once = settled([100.0, 100.0 * ratio], [0.0, 0.06])
    assert often[-1] == pytest.approx(once[-1], abs=1e-9)


def test_after_a_gap_of_five_time_constants_it_begins_in_equilibrium() -> None:
    longest_s = RESTART_TIME_CONSTANTS * GAMMA_TAU_S
    for gap_s, restarts in ((0.999 * longest_s, False), (1.001 * longest_s, True), (60.0, True)):
        out = settled([100.0, 100.0, 110.0], [0.0, 0.002, 0.002 + gap_s])
        assert (out[-1] == 110.0) == restarts


@pytest.mark.parametrize("nothing", [math.nan, math.inf, -math.inf, 0.0, -1.0])
def test_what_is_no_pressure_is_nan_and_changes_nothing_after_it(nothing: float) -> None:
    t_s = 0.002 * np.arange(9)
    kpa = 100.0 + 3.0 * np.arange(9)
    kpa[3] = nothing
    out = settled(kpa, t_s)
    assert np.flatnonzero(np.isnan(out)).tolist() == [3]
    rest = np.arange(9) != 3
    assert out[rest].tolist() == settled(kpa[rest], t_s[rest]).tolist()


def test_time_that_goes_back_begins_anew_and_time_that_stands_still_exchanges_nothing() -> None:
    out = settled([100.0, 104.0, 104.0, 108.0], [1.0, 1.0, 0.5, 0.5])
    adiabatic = given_way(104.0, 1.04**K)
    assert out == pytest.approx([100.0, adiabatic, 104.0, given_way(108.0, (108 / 104) ** K)])


def test_a_gas_that_does_not_warm_up_is_measured_as_it_is() -> None:
    kpa = 100.0 + 10.0 * np.sin(np.arange(50))
    assert settled(kpa, 0.002 * np.arange(50), gamma=1.0) == pytest.approx(kpa, abs=1e-9)


@given(
    kpa=st.lists(st.floats(50.0, 180.0), min_size=1, max_size=40),
    step_s=st.sampled_from([0.0, 1e-9, 1e-6, 0.002, 0.07, 60.0]),
    gamma=st.floats(1.0, 1.6),
)
def test_it_is_stable_for_any_step(kpa: list[float], step_s: float, gamma: float) -> None:
    out = settled(kpa, step_s * np.arange(len(kpa)), gamma=gamma, wall=0.0)
    # Never warmer or colder than without any exchange from the least to the greatest pressure.
    most = (max(kpa) / min(kpa)) ** ((gamma - 1) / gamma)
    assert (out >= np.array(kpa) / most - 1e-9).all()
    assert (out <= np.array(kpa) * most + 1e-9).all()
