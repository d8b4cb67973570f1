"""`hysteresis`, the branch that flows: undone whatever the load did, by the equation itself."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from service.estimation.effects import FLOW_FRACTION_MAX
from service.estimation.models import flow
from service.estimation.models.flow import STROKE_N_PER_S, FlowModel
from tests.builders.readings import through

PART, STRESS_N = 0.08, 0.3
STEP_S = 0.002


def compensated(
    apparent_n: Any,
    t_s: Any,
    *,
    part: float = PART,
    stress_n: float = STRESS_N,
    power: float = 4.0,
    borne_n: float = math.nan,
    away_n: float = math.nan,
) -> np.ndarray:
    model = FlowModel(np.array([part]), np.array([stress_n]), np.array([power]))
    t_ns = np.rint(1e9 * np.asarray(t_s, dtype=float)).astype(np.int64)
    seen = np.asarray(apparent_n, dtype=float), t_ns, borne_n, away_n
    return through(flow.compensate_flow, model.to_records(), flow.initial_state(1), *seen)


def borne_by_branch(t_s: np.ndarray, force_n: np.ndarray, power: float) -> np.ndarray:
    """The branch's stress under a force linear between instants, by a solver of stiff equations."""

    def change(slope: float) -> Any:
        flow = PART * STROKE_N_PER_S
        return lambda _, s: PART * slope - flow * np.sign(s) * (np.abs(s) / STRESS_N) ** power

    s, out = 0.0, [0.0]
    for i in range(1, len(t_s)):
        step_s = t_s[i] - t_s[i - 1]
        slope = (force_n[i] - force_n[i - 1]) / step_s
        solved = solve_ivp(change(slope), (0.0, step_s), [s], "LSODA", rtol=1e-9, atol=1e-12)
        s = float(solved.y[0, -1])
        out.append(s)
    return np.array(out)


@pytest.mark.parametrize("power", [2.5, 4.0, 6.0])
def test_a_walk_comes_back_from_what_the_bubble_gets_of_it(power: float) -> None:
    t_s = np.arange(0.0, 1.2, STEP_S)
    turns_s, turns_n = [0.0, 0.05, 0.09, 0.4, 0.45, 0.7, 1.2], [0.0, 0.0, 24.0, 18.0, 0.0, 0.0, 9.0]
    force_n = np.interp(t_s, turns_s, turns_n)
    apparent_n = force_n - borne_by_branch(t_s, force_n, power)
    assert np.abs(apparent_n - force_n).max() > 0.5
    # Two halves of a step stand for what happens within it: of fast ones a hundredth is left.
    assert np.abs(compensated(apparent_n, t_s, power=power) - force_n).max() < 0.02


def test_in_a_long_slow_stroke_the_branch_bears_its_stress() -> None:
    t_s = np.arange(0.0, 6.0, STEP_S)
    out = compensated(STROKE_N_PER_S * t_s, t_s)
    assert out[-1] - STROKE_N_PER_S * t_s[-1] == pytest.approx(STRESS_N, rel=1e-3)


def test_of_a_force_that_comes_at_once_the_branch_bears_its_part_and_then_lets_go() -> None:
    # ds/dt = -k s^4 from s0 = g F: s = s0 (1 + 3 k s0^3 t)^(-1/3), slower and slower
    t_s = np.array([0.0, 0.0, 0.01, 1.0, 100.0])
    k, s0 = PART * STROKE_N_PER_S / STRESS_N**4, 0.5 * PART * 20.0
    # A jump within no time: its first half flows for no time, and so does its second.
    jumped = 20.0 - 2.0 * s0
    rest = 20.0 - 2.0 * s0 * (1.0 + 3.0 * k * (2.0 * s0) ** 3 * t_s[2:]) ** (-1.0 / 3.0)
    out = compensated([0.0, jumped, *rest], t_s)
    # Each later step flows from where the one before ended: the closed form is of their sum.
    exact = 20.0 - 2.0 * s0 * (1.0 + 3.0 * k * (2.0 * s0) ** 3 * np.cumsum(t_s)[2:]) ** (-1.0 / 3.0)
    assert out[:3] == pytest.approx([0.0, 20.0, 20.0], abs=1e-9)
    assert np.abs(out[3:] - 20.0).max() < np.abs(exact - 20.0).max()


@given(
    force_n=st.lists(st.floats(-5.0, 60.0), min_size=1, max_size=40),
    steps_s=st.lists(st.sampled_from([0.0, 1e-9, 0.002, 0.1, 60.0]), min_size=40, max_size=40),
    part=st.sampled_from([0.0, 1e-9, 0.08, FLOW_FRACTION_MAX]),
    stress_n=st.sampled_from([0.02, 0.3, 2.0]),
    power=st.sampled_from([2.0, 4.0, 6.5]),
)
def test_forces_come_back_from_what_is_felt_of_them_after_any_steps(
    force_n: list[float], steps_s: list[float], part: float, stress_n: float, power: float
) -> None:
    t_s = np.cumsum(steps_s)[: len(force_n)]
    k, s, before, apparent = part * STROKE_N_PER_S / stress_n**power, 0.0, 0.0, []
    more = power - 1
    for i, force in enumerate(force_n):
        step_s = np.rint(1e9 * (t_s[i] - t_s[i - 1])) * 1e-9 if i else 0.0
        s += part * (force - before) / 2
        if abs(s) > 1e-40:
            s = math.copysign((abs(s) ** -more + more * k * step_s) ** (-1 / more), s)
        s += part * (force - before) / 2
        before = force
        apparent.append(force - s)
    out = compensated(apparent, t_s, part=part, stress_n=stress_n, power=power)
    assert out == pytest.approx(force_n, abs=1e-6)


@given(
    apparent_n=st.lists(st.floats(-50.0, 50.0), min_size=1, max_size=60),
    steps_s=st.lists(st.sampled_from([0.0, 1e-9, 1e-6, 0.002, 0.1, 60.0, 1e5]), min_size=60),
)
def test_it_is_stable_for_any_steps(apparent_n: list[float], steps_s: list[float]) -> None:
    # |s| is no more than g times all the way that the force has gone.
    out = compensated(apparent_n, np.cumsum(steps_s)[: len(apparent_n)])
    way_n = np.abs(np.diff(apparent_n, prepend=0.0)).sum()
    assert np.abs(out - apparent_n).max() <= PART / (1 - 2 * PART) * way_n + 1e-9


@given(st.lists(st.floats(-1.0, 50.0), min_size=2, max_size=30), st.floats(0.0, 1.0))
def test_more_apparent_force_is_more_force(apparent_n: list[float], more_n: float) -> None:
    t_s = STEP_S * np.arange(len(apparent_n))
    more = compensated([*apparent_n[:-1], apparent_n[-1] + more_n], t_s)
    assert more[-1] >= compensated(apparent_n, t_s)[-1] - 1e-12


def test_without_a_part_force_is_what_appears() -> None:
    apparent_n = np.sin(np.arange(20.0))
    assert compensated(apparent_n, STEP_S * np.arange(20), part=0.0).tolist() == apparent_n.tolist()


@pytest.mark.parametrize("nothing", [math.nan, math.inf, -math.inf])
def test_what_is_no_force_is_nan_and_changes_nothing_after_it(nothing: float) -> None:
    t_s, apparent_n = STEP_S * np.arange(9), 3.0 * np.arange(9)
    apparent_n[4] = nothing
    rest = np.arange(9) != 4
    out = compensated(apparent_n, t_s)
    assert np.isnan(out).tolist() == (~rest).tolist()
    assert out[rest].tolist() == compensated(apparent_n[rest], t_s[rest]).tolist()


def test_after_a_stretch_unseen_a_load_may_have_gone_just_now() -> None:
    t_s, apparent_n = [0.0, 10.0], [0.0, 1.0]
    straight = compensated(apparent_n, t_s)
    away = compensated(apparent_n, t_s, away_n=30.0)
    # A single step of 10 s: what the branch bears of the straight line is found roughly.
    assert straight[1] == pytest.approx(1.0 + STRESS_N * 0.01**0.25, abs=0.02)
    # All of what 30 N less have put on the branch hides: 0.08 of it.
    assert away[1] == pytest.approx((1.0 - PART * 30.0) / (1.0 - PART), abs=1e-9)
