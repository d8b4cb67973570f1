"""The rig's forward model against the ladder's inverse: force, pressure and force again."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.estimation.fitting.dome_model import DomeModel, DomeResponse
from service.estimation.models import flow, gas, hysteresis, rubber
from tests.builders.readings import make_rubber, through

CURVE = np.array([22.0, 5.0, 5.0])
SCALE_KPA, BASE_KPA, WALL = 16.0, 100.3, 0.00124
PART, CREEP_S, LOOP = (0.05, 0.04), (0.08, 1.2), (0.03, 0.04, 0.05)


def respond(
    t_ns: np.ndarray,
    force_n: np.ndarray,
    *,
    gamma: float = 1.0,
    part: tuple[float, ...] = (),
    loop: tuple[float, ...] = (),
    flow: tuple[float, float, float] = (0.0, 1.0, 4.0),
) -> DomeResponse:
    creep = np.array(part), np.array(CREEP_S[: len(part)])
    model = DomeModel(CURVE, SCALE_KPA, BASE_KPA, WALL, gamma, 0.011, *creep, np.array(loop), *flow)
    return model.compute_response(t_ns * 1e-9, force_n)


def compute_apparent_n(kpa: np.ndarray) -> np.ndarray:
    """Compute the curve's force at a pressure."""
    x = (kpa - BASE_KPA) / SCALE_KPA
    c1, c2, c3 = CURVE
    return np.asarray(x * (c1 + x * (c2 + x * c3)))


def draw_load(seed: int, n: int = 120) -> tuple[np.ndarray, np.ndarray]:
    """Draw instants at any steps, and a load that comes and goes, from 0 on."""
    rng = np.random.default_rng(seed)
    t_ns = np.cumsum(rng.choice([1_838_235, 1_000, 20_000_000, 10**10], n)).astype(np.int64)
    force_n = np.maximum(0.0, 14.0 + 14.0 * np.sin(np.cumsum(rng.normal(0, 0.7, n))))
    force_n[0] = 0.0
    return t_ns, force_n


@settings(max_examples=20)
@given(seed=st.integers(0, 1000))
def test_creep_and_loop_are_compensated_to_a_nanonewton(seed: int) -> None:
    t_ns, force_n = draw_load(seed)
    law = (0.08, 0.3, 4.7)
    out = respond(t_ns, force_n, part=PART, loop=LOOP, flow=law)
    sprung = flow.FlowParams.array(1, fraction=law[0], stress_scale_n=law[1], exponent=law[2])
    loop = hysteresis.HysteresisParams.array(1, play_weights=[LOOP])
    creep, nan = make_rubber(PART, CREEP_S), math.nan
    felt_n = compute_apparent_n(out.kpa)
    felt_n = through(flow.compensate_flow, sprung, flow.FlowState.array(1), felt_n, t_ns, nan, nan)
    felt_n = through(
        hysteresis.compensate_hysteresis,
        loop,
        hysteresis.HysteresisState.array(1),
        felt_n,
        nan,
    )
    felt_n = through(
        rubber.compensate_creep, creep, rubber.RubberState.array(1), felt_n, t_ns, nan, nan
    )
    assert felt_n == pytest.approx(force_n, abs=1e-9)
    assert out.force_lag_n == pytest.approx(force_n - compute_apparent_n(out.kpa), abs=1e-9)


@settings(max_examples=20)
@given(seed=st.integers(0, 1000), gamma=st.floats(1.01, 1.4))
def test_the_gas_is_compensated_as_exactly_as_the_forward_model_is_solved(
    seed: int, gamma: float
) -> None:
    # Six rounds, each of which leaves less than k = (gamma - 1)/gamma of the error.
    t_ns, force_n = draw_load(seed)
    out = respond(t_ns, force_n, gamma=gamma)
    model = gas.GasParams.array(
        1, gamma=gamma, tau_s=0.011, wall_per_kpa=WALL, baseline_kpa=BASE_KPA
    )
    settled = through(
        gas.compute_isothermal_pressure,
        model,
        gas.GasState.array(1),
        out.kpa,
        t_ns,
        math.nan,
    )
    # After a long pause the inverse begins in equilibrium, where the rest of the heat is lost.
    long = np.diff(t_ns, prepend=t_ns[0]) > gas.RESTART_TIME_CONSTANTS * gamma * 0.011e9
    off_kpa = np.abs(settled - out.isothermal_kpa)[1:]
    jump_kpa = 0.5 * np.abs(np.diff(out.isothermal_kpa))
    assert (off_kpa[~long[1:]] <= ((gamma - 1) / gamma) ** 6 * 2.0 * jump_kpa.max() + 0.05).all()
    assert np.median(off_kpa) < 0.01


def test_a_dome_without_effects_inverts_its_curve() -> None:
    force_n = np.linspace(-2.0, 40.0, 100)
    out = respond(np.arange(100) * 10**6, force_n)
    inside = (force_n >= 0.0) & (force_n <= CURVE.sum())
    assert compute_apparent_n(out.kpa[inside]) == pytest.approx(force_n[inside], abs=1e-9)
    assert out.kpa.tolist() == out.isothermal_kpa.tolist()
    assert (np.diff(out.kpa) > 0.0).all()


def test_a_trial_curve_that_falls_has_finite_pressures() -> None:
    falling = DomeModel(
        np.array([20.0, -40.0, 5.0]), SCALE_KPA, BASE_KPA, WALL, 1.3, 0.011, np.array(PART),
        np.array(CREEP_S), np.array(LOOP), 0.08, 0.3, 4.0,
    )  # fmt: skip
    out = falling.compute_response(np.linspace(0, 0.098, 50), np.linspace(0, 60, 50))
    assert np.isfinite(np.stack(out)).all()
