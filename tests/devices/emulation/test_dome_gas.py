"""The gas in a dome: heat flows as in a sphere, and fast loads overshoot."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from devices.emulation.dome_physics import GRID_S
from tests.devices.emulation.domes import (
    PART,
    Floats,
    domes_of,
    grid,
    kpa_at,
    lost,
    ramp,
    static_kpa,
)

GAMMA = 1.4


def adiabatic_kpa(force_n: float, gamma: float = GAMMA) -> float:
    """Return the root of p (V (1 + c (p - seal)))^gamma = seal."""
    v, c = float(1 - lost(force_n)), PART.wall_per_kpa
    return float(brentq(lambda p: p * (v * (1 + c * (p - 100.0))) ** gamma - 100.0, 100.0, 200.0))


@pytest.mark.parametrize("force_n", [5.0, 15.0, 30.0])
def test_a_fast_load_overshoots_by_less_than_adiabatic_and_relaxes(force_n: float) -> None:
    step = ramp(0.1, 0.1 + GRID_S, force_n)
    t_s = grid(0.1 + GRID_S, 0.4)
    kpa = kpa_at(domes_of(step, gas=True), t_s)
    static = float(static_kpa(force_n))
    overshoot = adiabatic_kpa(force_n) - static
    assert static < kpa[0] < static + overshoot
    assert kpa[0] > static + 0.6 * overshoot, "within 0.5 ms little heat is lost"
    assert (np.diff(kpa) < 0).all()
    assert kpa[-1] == pytest.approx(static, abs=1e-3)


@pytest.mark.parametrize("gamma", [1.1, 1.25])
def test_a_gas_with_vapours_in_it_overshoots_by_less_than_air(gamma: float) -> None:
    step = ramp(0.1, 0.1 + GRID_S, 15.0)
    part = replace(PART, kappa=(gamma - 1) / gamma, conduction_s=0.2)
    kpa = kpa_at(domes_of(step, part, gas=True), [0.1 + GRID_S])
    static = float(static_kpa(15.0))
    overshoot = adiabatic_kpa(15.0, gamma) - static
    assert 0.8 * overshoot < kpa[0] - static < overshoot


def test_a_fast_release_undershoots_and_recovers() -> None:
    release = np.array([0.5, 0.5 + GRID_S])
    domes = domes_of(lambda t_s: np.interp(t_s, release, [20.0, 0.0]), gas=True)
    kpa = kpa_at(domes, grid(0.5 + GRID_S, 0.8))
    assert kpa[0] < 98.0
    assert (np.diff(kpa) > 0).all()
    assert kpa[-1] == pytest.approx(100.0, abs=1e-3)


def test_a_slow_load_shows_no_gas_effect() -> None:
    t_s = grid(0.0, 20.0, every=400)
    slow = ramp(0.0, 20.0, 30.0)
    difference = kpa_at(domes_of(slow, gas=True), t_s) - static_kpa(slow(t_s))
    assert np.abs(difference).max() < 0.01


def sphere_kpa(
    force: Callable[[float], tuple[float, float]],
    conduction_s: float,
    t_s: Floats,
    begin_s: float,
) -> Floats:
    """Return the pressure in a gas-filled sphere with an isothermal wall, by finite differences.

    theta(r) is the temperature above the wall's in kelvin, radius 1; u = r theta obeys
    u_t = a u_rr + r kappa T (ln p)_t with r^2 / (pi^2 a) = conduction_s. `force` gives the force
    and its rate. Pressure follows from p V (1 + c (p - seal)) = seal T_mean / T_wall.
    """
    wall_k, kappa = 294.15, (GAMMA - 1) / GAMMA
    n = 120
    r = np.linspace(0, 1, n + 1)
    weights = 3 * r**2 / n
    weights[-1] /= 2
    weights /= weights.sum()
    diffusivity = 1 / (np.pi**2 * conduction_s)
    c, seal = PART.wall_per_kpa, PART.seal_kpa

    def theta_of(u: Floats) -> Floats:
        theta = np.zeros(n + 1)
        theta[1:-1] = u / r[1:-1]
        theta[0] = (4 * theta[1] - theta[2]) / 3  # flat at the centre
        return theta

    def pressure(theta: Floats, force_n: float) -> float:
        right = seal * (1 + weights @ theta / wall_k) / (1 - float(lost(force_n)))
        b = 1 - c * seal
        return float((-b + np.sqrt(b * b + 4 * c * right)) / (2 * c))

    def rate(t: float, u: Floats) -> Floats:
        theta = theta_of(u)
        force_n, force_n_s = force(t)
        p = pressure(theta, force_n)
        conducted = np.zeros(n + 1)
        padded = np.concatenate([[0.0], u, [0.0]])
        conducted[1:-1] = diffusivity * np.diff(padded, 2) * n**2 / r[1:-1]
        conducted[0] = conducted[1]
        volume = 1 - float(lost(force_n))
        ln_volume_s = -PART.stiffening / (PART.knee_n + force_n) * force_n_s / volume
        mean_k = wall_k + weights @ theta
        # d/dt of the gas law, solved for d(ln p)/dt
        give = 1 + c * p / (1 + c * (p - seal))
        uniform = weights[:-1].sum()  # the wall itself does not warm
        ln_p_s = (weights @ conducted / mean_k - ln_volume_s) / (give - kappa * uniform)
        return np.asarray((conducted + kappa * (wall_k + theta) * ln_p_s)[1:-1] * r[1:-1])

    solved = solve_ivp(
        rate, (begin_s, t_s[-1]), np.zeros(n - 1), "LSODA", t_s, rtol=1e-7, atol=1e-7, max_step=2e-3
    )
    assert solved.success
    return np.array(
        [pressure(theta_of(u), force(t)[0]) for t, u in zip(t_s, solved.y.T, strict=True)]
    )


@pytest.mark.parametrize("conduction_s", [0.008, 0.042])
def test_heat_flows_as_in_a_sphere_solved_by_finite_differences(conduction_s: float) -> None:
    full_n, rise_s, begin_s = 15.0, 0.010, 0.1

    def force(t: float) -> tuple[float, float]:
        phase = math.pi * min(max((t - begin_s) / rise_s, 0.0), 1.0)
        return full_n * (1 - math.cos(phase)) / 2, full_n * math.pi / rise_s * math.sin(phase) / 2

    t_s = grid(begin_s, begin_s + 0.15, every=2)
    expected = sphere_kpa(force, conduction_s, t_s, begin_s)
    domes = domes_of(
        lambda t_s: np.array([force(float(t))[0] for t in t_s]),
        replace(PART, conduction_s=conduction_s),
        gas=True,
    )
    kpa = kpa_at(domes, t_s)
    excess = expected - static_kpa([force(float(t))[0] for t in t_s])
    assert excess.max() > 0.5
    assert np.abs(kpa - expected).max() < 0.01 * excess.max()


@pytest.mark.parametrize("conduction_s", [0.010, 0.040])
def test_late_heat_decays_with_the_slowest_mode_of_a_sphere_of_constant_volume(
    conduction_s: float,
) -> None:
    # conduction_s is that of constant pressure. At constant volume the pressure falls with the
    # temperature and cools the gas besides: with d(ln p) = (sum of modes)' / (T give), a common
    # decay exp(-x t / conduction_s) of all modes satisfies the equation below.
    n = np.arange(1, 400)
    give = 1 + 0.00124 * 100.0

    def common_decay(x: float) -> float:
        return float(give + (GAMMA - 1) / GAMMA * x * (6 / (np.pi * n) ** 2 / (n**2 - x)).sum())

    x = brentq(common_decay, 1.000001, 3.999)
    step = ramp(0.1, 0.1 + GRID_S, 2.0)
    t_s = grid(0.15, 0.21)
    domes = domes_of(step, replace(PART, conduction_s=conduction_s), gas=True)
    excess = kpa_at(domes, t_s) - float(static_kpa(2.0))
    slope = np.polyfit(t_s, np.log(excess), 1)[0]
    assert -slope == pytest.approx(x / conduction_s, rel=0.01)
