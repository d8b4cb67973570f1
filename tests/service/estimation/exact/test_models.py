"""Every model of the ladder against its equations at fifty digits, in hard cases.

The same float64 readings go in. Goal of the design: less than 1e-9 N apart.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mpmath import mpf

from service.estimation.models import ambient, denoise, flow, gas, hysteresis, rubber, temperature
from service.estimation.tare.unloaded_windows import compute_variance_inflation
from tests.builders.averages import denoised
from tests.builders.readings import make_rubber, through
from tests.service.estimation.exact import digits, sample_stage, smoothing_stage

GOAL = 1e-9
NAN = float("nan")
STEPS_NS = [2_000_000] * 8 + [0, 1, 1000, 17_000_000, 200_000_000, 60 * 10**9, -3_000_000]


def draw_instants(rng: np.random.Generator, n: int) -> np.ndarray:
    """Draw instants with gaps of a minute, steps of 0 and 1 ns, and some backwards."""
    return np.cumsum(rng.choice(STEPS_NS, n)).astype(np.int64)


def damage(rng: np.random.Generator, values: np.ndarray) -> np.ndarray:
    """Replace a tenth of the values by NaN or infinity, as from a bad file."""
    return np.where(rng.random(values.shape) < 0.1, rng.choice([NAN, np.inf, -np.inf]), values)


seeds = st.integers(0, 2**32 - 1)


@settings(max_examples=15)
@given(
    gamma=st.sampled_from([1.0, 1.0 + 1e-12, 1.001, 1.28, 1.6]),
    tau_s=st.sampled_from([1e-9, 0.0005, 0.012, 0.042, 100.0]),
    seed=seeds,
)
def test_gas_is_within_a_micropascal(gamma: float, tau_s: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    kpa = damage(rng, 100.0 + np.cumsum(rng.normal(0, 2.0, 40)))
    t_ns = draw_instants(rng, 40)
    model = gas.GasParams.array(
        1, gamma=gamma, tau_s=tau_s, wall_per_kpa=0.00124, baseline_kpa=100.1
    )
    found = through(gas.compute_isothermal_pressure, model, gas.GasState.array(1), kpa, t_ns, NAN)
    parameters = (mpf(gamma), mpf(tau_s), mpf(0.00124), mpf(100.1))
    expected = sample_stage.gas(digits.exact(kpa), t_ns.tolist(), *parameters)
    assert digits.apart(found[:, None], expected) < GOAL


@settings(max_examples=15)
@given(
    parts=st.sampled_from([(0.05, 0.04), (0.0, 0.0), (0.4, 0.4), (0.9, 0.05)]),
    taus_s=st.sampled_from([(0.06, 1.1), (1e-9, 1e-6), (1e3, 1e6), (0.05, 0.05)]),
    seed=seeds,
)
def test_rubber_is_within_a_nanonewton(
    parts: tuple[float, float], taus_s: tuple[float, float], seed: int
) -> None:
    rng = np.random.default_rng(seed)
    apparent_n = damage(rng, 15.0 + np.cumsum(rng.normal(0, 2.0, 40)))
    t_ns = draw_instants(rng, 40)
    model = make_rubber(parts, taus_s)
    seen = apparent_n, t_ns, NAN, NAN
    found = through(rubber.compensate_creep, model, rubber.RubberState.array(1), *seen)
    expected = smoothing_stage.rubber(
        digits.exact(apparent_n),
        t_ns.tolist(),
        [mpf(g) for g in parts],
        [mpf(tau) for tau in taus_s],
    )
    assert digits.apart(found[:, None], expected) < GOAL


@pytest.mark.slow
@settings(max_examples=15)
@given(
    part=st.sampled_from([0.0, 1e-9, 0.08, 0.4]),
    stress_n=st.sampled_from([0.01, 0.3, 2.0]),
    power=st.sampled_from([1.5, 4.0, 5.3, 10.0]),
    swing_n=st.sampled_from([0.01, 0.5, 5.0]),
    seed=seeds,
)
def test_flow_is_within_a_nanonewton(
    part: float, stress_n: float, power: float, swing_n: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    apparent_n = damage(rng, 3.0 + np.cumsum(rng.normal(0, swing_n, 40)))
    t_ns = draw_instants(rng, 40)
    model = flow.FlowParams.array(1, fraction=part, stress_scale_n=stress_n, exponent=power)
    seen = apparent_n, t_ns, NAN, NAN
    found = through(flow.compensate_flow, model, flow.FlowState.array(1), *seen)
    expected = smoothing_stage.flow(
        digits.exact(apparent_n), t_ns.tolist(), mpf(part), mpf(stress_n), mpf(power)
    )
    assert digits.apart(found[:, None], expected) < GOAL


@settings(max_examples=15)
@given(
    parts=st.sampled_from([(0.05, 0.04, 0.03), (0.0, 0.0, 0.0), (0.3, 0.3, 0.3), (0, 0, 0.999)]),
    swing_n=st.sampled_from([0.01, 0.5, 5.0, 1e4]),
    seed=seeds,
)
def test_hysteresis_is_within_a_nanonewton(
    parts: tuple[float, float, float], swing_n: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    apparent_n = damage(rng, rng.choice([0.0, 3.0, 20.0]) + np.cumsum(rng.normal(0, swing_n, 40)))
    model = hysteresis.HysteresisParams.array(1, play_weights=[parts])
    state = hysteresis.HysteresisState.array(1)
    found = through(hysteresis.compensate_hysteresis, model, state, apparent_n, NAN)
    expected = smoothing_stage.hysteresis(digits.exact(apparent_n), [mpf(w) for w in parts])
    assert digits.apart(found[:, None], expected) < GOAL * max(1.0, swing_n)


@settings(max_examples=15)
@given(lag_s=st.sampled_from([-30.0, -2.0, -0.3, 0.0, 1e-9, 0.3, 3.3, 30.0, 1e9]), seed=seeds)
def test_temperature_is_within_a_billionth_of_a_count(lag_s: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    temperature_raw = damage(rng, 480.0 - rng.integers(0, 40, 60))
    t_ns = draw_instants(rng, 60)
    found = temperature.compute_gas_counts_and_rise_per_s(
        temperature_raw[:, None], t_ns[:, None], np.array([lag_s])
    )
    exactly = sample_stage.temperature(digits.exact(temperature_raw), t_ns.tolist(), mpf(lag_s))
    for column, expected in zip(found, exactly, strict=True):
        assert digits.apart(column, expected) < 1e-9


@settings(max_examples=15)
@given(seed=seeds)
def test_ambient_is_within_a_micropascal(seed: int) -> None:
    rng = np.random.default_rng(seed)
    kpa = damage(rng, rng.normal(0, 1.0, 60))
    t_ns = draw_instants(rng, 60)
    found = through(ambient.low_pass_ambient_kpa, None, ambient.AmbientState.array(1), kpa, t_ns)
    expected = sample_stage.smoothed(digits.exact(kpa), t_ns.tolist())
    assert digits.apart(found[:, None], expected) < GOAL


@pytest.mark.slow
@pytest.mark.parametrize("look_ms", [0, 10, 100])
@pytest.mark.parametrize("kind", ["still", "moving", "uneven", "few", "crowded"])
@pytest.mark.parametrize("lasts", [0.0, 0.6])
def test_denoise_is_within_a_nanonewton(look_ms: int, kind: str, lasts: float) -> None:
    rng = np.random.default_rng([look_ms, len(kind)])
    n = 90
    readings = np.maximum(np.arange(denoise.WINDOW_READINGS_MAX + 1), 1)
    noise_left = compute_variance_inflation(np.array([lasts]), np.array([6.0]), readings)
    swing_n = {"still": 0.0, "moving": 25.0, "uneven": 5.0, "few": 1.0, "crowded": 0.0}[kind]
    values = 30.0 + swing_n * np.sin(np.arange(n) / 9.0) + rng.normal(0, 0.3, n)
    steps_ns = np.full(n, 2_000_000)
    if kind == "uneven":
        steps_ns = rng.choice([2_000_000] * 20 + [1, 40_000_000], n)
    if kind == "crowded":  # at two instants that are six digits further apart than each is wide
        steps_ns = np.tile([17, 17, 17, 17, 1_800_000], n // 5)
    frame_ns = np.cumsum(steps_ns)
    t_ns = frame_ns + (0 if kind == "crowded" else rng.choice([0, 700_000], n))
    missing = rng.random(n) < (0.6 if kind == "few" else 0.05)
    run = np.arange(n) // 10 if kind == "crowded" else np.cumsum(rng.random(n) < 0.03)
    column = np.where(missing, NAN, values)
    averaged, left, bend, of_bend = denoised(
        column[:, None],
        np.full((n, 1), 0.3),
        t_ns[:, None],
        frame_ns,
        frame_ns[:, None].copy(),
        run.astype(np.int64),
        look_ms * 1_000_000,
        noise_left[None, :],
    )
    found = smoothing_stage.denoised(
        digits.exact(column),
        [mpf(0.3)] * n,
        t_ns.tolist(),
        frame_ns.tolist(),
        frame_ns.tolist(),
        run.tolist(),
        look_ms * 1_000_000,
        noise_left,
    )
    assert digits.apart(averaged, [None if x is None else x[0] for x in found]) < GOAL
    assert digits.apart(left, [None if x is None else x[1] for x in found]) < GOAL
    there = [x for x in found if x is not None]
    known = np.isfinite(averaged[:, 0])
    assert digits.apart(bend[known], [x[2] for x in there]) < GOAL
    assert digits.apart(of_bend[known], [x[3] for x in there]) < GOAL
