"""`hysteresis`: compensation of the rubber's flowing branch."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from service.estimation.models import flow
from service.estimation.models.flow import STROKE_N_PER_S, FlowParams, FlowState
from tests.builders.readings import through

PART, STRESS_N = 0.08, 0.3
STEP_S = 0.002


def compensate(
    apparent_n: Any, t_s: Any, *, power: float = 4.0, away_n: float = math.nan
) -> np.ndarray:
    model = FlowParams.array(1, fraction=PART, stress_scale_n=STRESS_N, exponent=power)
    t_ns = np.rint(1e9 * np.asarray(t_s, dtype=float)).astype(np.int64)
    readings = np.asarray(apparent_n, dtype=float), t_ns, math.nan, away_n
    return through(flow.compensate_flow, model, FlowState.array(1), *readings)


def solve_branch_stress(t_s: np.ndarray, force_n: np.ndarray, power: float) -> np.ndarray:
    """Solve the branch's stress under a force that is linear between instants."""
    stress_n = [0.0]
    for step_s, change_n in zip(np.diff(t_s), np.diff(force_n), strict=True):
        solved = solve_ivp(
            lambda _, s, slope: (
                PART * (slope - STROKE_N_PER_S * np.sign(s) * (np.abs(s) / STRESS_N) ** power)
            ),
            (0.0, step_s), [stress_n[-1]], "LSODA", rtol=1e-9, atol=1e-12,
            args=(change_n / step_s,),
        )  # fmt: skip
        stress_n.append(float(solved.y[0, -1]))
    return np.array(stress_n)


@pytest.mark.parametrize("power", [2.5, 4.0, 6.0])
def test_the_forces_of_a_walk_are_recovered(power: float) -> None:
    t_s = np.arange(0.0, 1.2, STEP_S)
    turns_s, turns_n = [0.0, 0.05, 0.09, 0.4, 0.45, 0.7, 1.2], [0.0, 0.0, 24.0, 18.0, 0.0, 0.0, 9.0]
    force_n = np.interp(t_s, turns_s, turns_n)
    apparent_n = force_n - solve_branch_stress(t_s, force_n, power)
    assert np.abs(apparent_n - force_n).max() > 0.5
    # Two halves of a step stand for a whole one: of fast changes a hundredth is left.
    assert np.abs(compensate(apparent_n, t_s, power=power) - force_n).max() < 0.02


def test_the_branch_reaches_its_stress_in_a_long_slow_stroke() -> None:
    t_s = np.arange(0.0, 6.0, STEP_S)
    out = compensate(STROKE_N_PER_S * t_s, t_s)
    assert out[-1] - STROKE_N_PER_S * t_s[-1] == pytest.approx(STRESS_N, rel=1e-3)


@given(
    apparent_n=st.lists(st.floats(-50.0, 50.0), min_size=1, max_size=60),
    steps_s=st.lists(st.sampled_from([0.0, 1e-9, 1e-6, 0.002, 0.1, 60.0, 1e5]), min_size=60),
)
def test_the_compensation_is_stable_for_any_steps(
    apparent_n: list[float], steps_s: list[float]
) -> None:
    # |s| is no more than g times all changes of the force.
    out = compensate(apparent_n, np.cumsum(steps_s)[: len(apparent_n)])
    change_n = np.abs(np.diff(apparent_n, prepend=0.0)).sum()
    assert np.abs(out - apparent_n).max() <= PART / (1 - 2 * PART) * change_n + 1e-9


@given(st.lists(st.floats(-1.0, 50.0), min_size=2, max_size=30), st.floats(0.0, 1.0))
def test_more_apparent_force_is_more_force(apparent_n: list[float], more_n: float) -> None:
    t_s = STEP_S * np.arange(len(apparent_n))
    more = compensate([*apparent_n[:-1], apparent_n[-1] + more_n], t_s)
    assert more[-1] >= compensate(apparent_n, t_s)[-1] - 1e-12


def test_a_load_may_have_ended_at_the_end_of_a_gap() -> None:
    t_s, apparent_n = [0.0, 10.0], [0.0, 1.0]
    straight = compensate(apparent_n, t_s)
    away = compensate(apparent_n, t_s, away_n=30.0)
    # A single step of 10 s: the stress under a straight line is found roughly.
    assert straight[1] == pytest.approx(1.0 + STRESS_N * 0.01**0.25, abs=0.02)
    # The branch hides its stress under 30 N less, 0.08 N a newton.
    assert away[1] == pytest.approx((1.0 - PART * 30.0) / (1.0 - PART), abs=1e-9)
