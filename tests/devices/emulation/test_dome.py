"""The emulated dome against its own laws: statics, heat, creep, loop, weather; each by itself.

Expectations come from physics worked out here (a sphere solved by finite differences, exponentials,
two lags in series) and from hardware.md 9, not from the emulation's own numbers.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from devices.emulation.dome import GRID_S, Domes
from devices.emulation.parts import DomePart
from devices.emulation.surroundings import Surroundings
from devices.scene.emulation import EmulationScene

Floats = npt.NDArray[np.float64]
Force = Callable[[Floats], Floats]

PART = DomePart(
    seal_kpa=100.0,
    knee_n=10.0,
    stiffening=0.085,
    wall_per_kpa=0.00124,  # Vytaflex 60, hardware.md 9
    conduction_s=0.020,
    gas_lag_s=4.0,
    chip_lag_s=1.0,
    creep_parts=(0.03, 0.02, 0.04),
    creep_s=(0.04, 0.3, 2.0),
    loop_n=0.45,
)
GAMMA = 1.4
ALL: dict[str, Any] = {"gas": True, "rubber": True, "hysteresis": True}


class Pressing:
    """The same force, as a function of time, on every dome."""

    def __init__(self, force: Force, domes: int) -> None:
        self._force = force
        self._domes = domes

    def forces_n(self, t_s: Floats) -> Floats:
        return np.repeat(self._force(np.asarray(t_s))[:, None], self._domes, axis=1)


def nothing(t_s: Floats) -> Floats:
    return np.zeros_like(t_s)


def domes_of(
    force: Force = nothing, *parts: DomePart, label: str = "test", **effects: Any
) -> Domes:
    """Domes under a force, with only the named effects on."""
    scene = EmulationScene(**({"gas": False, "rubber": False, "hysteresis": False} | effects))
    parts = parts or (PART,)
    serials = [f"S{i}" for i in range(len(parts))]
    load = Pressing(force, len(parts))
    return Domes(parts, serials, load, scene, Surroundings(scene), label)


def kpa_at(domes: Domes, t_s: npt.ArrayLike, dome: int = 0) -> Floats:
    return np.array([domes.pressure_kpa(dome, float(t)) for t in np.asarray(t_s)])


def grid(begin_s: float, end_s: float, every: int = 1) -> Floats:
    """Grid points, between which the emulation is linear."""
    steps = np.arange(round(begin_s / GRID_S), round(end_s / GRID_S) + 1, every)
    return np.asarray(steps * GRID_S, dtype=np.float64)


def lost(force_n: npt.ArrayLike, part: DomePart = PART) -> Floats:
    """Part of the bubble's volume that a slow force takes."""
    return np.asarray(part.stiffening * np.log1p(np.asarray(force_n) / part.knee_n))


def static_kpa(force_n: npt.ArrayLike, part: DomePart = PART) -> Floats:
    """Positive root of p (1 + c (p - seal)) (1 - lost) = seal."""
    c, seal = part.wall_per_kpa, part.seal_kpa
    v = 1 - lost(force_n, part)
    b = 1 - c * seal
    return np.asarray((-b + np.sqrt(b * b + 4 * c * seal / v)) / (2 * c))


def felt_n(kpa: Floats, part: DomePart = PART) -> Floats:
    """The static force that would give this pressure."""
    v = part.seal_kpa / (kpa * (1 + part.wall_per_kpa * (kpa - part.seal_kpa)))
    return np.asarray(part.knee_n * np.expm1((1 - v) / part.stiffening))


def ramp(begin_s: float, end_s: float, to_n: float) -> Force:
    return lambda t_s: np.interp(t_s, [begin_s, end_s], [0.0, to_n])


# Statics


parts = st.builds(
    DomePart,
    seal_kpa=st.floats(95, 105),
    knee_n=st.floats(5, 15),
    stiffening=st.floats(0.05, 0.1),
    wall_per_kpa=st.floats(0.0005, 0.004),
    conduction_s=st.just(0.02),
    gas_lag_s=st.just(4.0),
    chip_lag_s=st.just(1.0),
    creep_parts=st.just((0.03, 0.02, 0.04)),
    creep_s=st.just((0.04, 0.3, 2.0)),
    loop_n=st.just(0.45),
)


@settings(max_examples=25, deadline=None)
@given(part=parts, force_n=st.floats(0, 60))
def test_without_effects_the_pressure_obeys_the_static_law(part: DomePart, force_n: float) -> None:
    p = domes_of(lambda t_s: np.full_like(t_s, force_n), part).pressure_kpa(0, 0.1)
    volume = 1 - part.stiffening * math.log(1 + force_n / part.knee_n)
    assert p * (1 + part.wall_per_kpa * (p - part.seal_kpa)) * volume == pytest.approx(
        part.seal_kpa, rel=1e-12
    )


def test_an_unloaded_dome_keeps_the_pressure_it_was_sealed_at() -> None:
    t_s = grid(0.0, 3.0, every=100)
    np.testing.assert_allclose(kpa_at(domes_of(nothing, **ALL), t_s), 100.0, atol=1e-9)


def test_the_static_curve_is_concave_and_rises_to_the_end_of_the_range() -> None:
    force_n = np.linspace(0, 60, 121)
    kpa = kpa_at(domes_of(ramp(0.0, 1.2, 60.0)), force_n * 0.02)
    assert (np.diff(kpa) > 0).all()
    assert (np.diff(kpa, 2) < 0).all()


@pytest.mark.parametrize("force_n", [1.0, 15.0, 40.0])
def test_with_every_effect_on_a_load_that_is_held_ends_at_the_static_law(force_n: float) -> None:
    domes = domes_of(ramp(0.5, 2.0, force_n), gas=True, rubber=True)
    # Ten times the slowest term of creep
    assert domes.pressure_kpa(0, 22.0) == pytest.approx(float(static_kpa(force_n)), abs=1e-3)


# Each effect can be switched off


def tap(t_s: Floats) -> Floats:
    """Loaded with 20 N within 10 ms at 0.2 s, released within 10 ms at 0.5 s."""
    return np.interp(t_s, [0.2, 0.21, 0.5, 0.51], [0.0, 20.0, 20.0, 0.0])


@pytest.mark.parametrize("effect", ["gas", "rubber", "hysteresis"])
def test_an_effect_makes_a_difference_only_if_it_is_switched_on(effect: str) -> None:
    t_s = grid(0.0, 1.0)
    static = static_kpa(tap(t_s))
    np.testing.assert_allclose(kpa_at(domes_of(tap), t_s), static, atol=1e-9)
    only: dict[str, Any] = {effect: True}
    difference = np.abs(kpa_at(domes_of(tap, **only), t_s) - static)
    assert difference.max() > 0.1, "about a count"
    np.testing.assert_allclose(difference[t_s < 0.2], 0, atol=1e-9)


def test_the_effects_do_not_hide_one_another() -> None:
    t_s = grid(0.0, 0.8)
    everything = kpa_at(domes_of(tap, **ALL), t_s)
    for effect in ALL:
        without = kpa_at(domes_of(tap, **(ALL | {effect: False})), t_s)
        assert np.abs(everything - without).max() > 0.1


# Gas


def adiabatic_kpa(force_n: float) -> float:
    """Root of p (V (1 + c (p - seal)))^gamma = seal, by bisection."""
    v = float(1 - lost(force_n))
    low, high = 100.0, 200.0
    for _ in range(80):
        p = (low + high) / 2
        if p * (v * (1 + PART.wall_per_kpa * (p - 100.0))) ** GAMMA < 100.0:
            low = p
        else:
            high = p
    return low


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
    """A gas-filled sphere with an isothermal wall, by finite differences.

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
    assert excess.max() > 0.5, "there has to be something to compare"
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


# Creep


def test_creep_is_the_sum_of_its_exponentials() -> None:
    begin_s = 0.3
    step = ramp(begin_s - GRID_S, begin_s, 20.0)
    t_s = grid(begin_s, 6.0, every=20)
    felt = felt_n(kpa_at(domes_of(step, rubber=True), t_s))
    missing = sum(
        share * np.exp(-(t_s - begin_s + GRID_S / 2) / tau_s)
        for share, tau_s in zip(PART.creep_parts, PART.creep_s, strict=True)
    )
    np.testing.assert_allclose(felt, 20.0 * (1 - missing), atol=2e-4)


def test_after_a_release_the_rubber_lets_go_slowly_and_never_pulls() -> None:
    domes = domes_of(lambda t_s: np.interp(t_s, [10, 10.001], [20.0, 0.0]), rubber=True)
    kpa = kpa_at(domes, grid(10.001, 30.0, every=200))
    assert kpa[0] == pytest.approx(float(static_kpa(20.0 * 0.09)), abs=0.05)
    assert (np.diff(kpa) < 1e-12).all()
    assert (kpa > 100.0).all()
    assert kpa[-1] == pytest.approx(100.0, abs=0.01)


# Hysteresis


def triangle(t_s: Floats, peak_n: float = 30.0, half_s: float = 2.0) -> Floats:
    return np.interp(t_s, [0, half_s, 2 * half_s], [0.0, peak_n, 0.0])


def loop(half_s: float, loads_n: Floats, peak_n: float = 30.0) -> tuple[Floats, Floats]:
    """Forces felt at the same loads on the way up and on the way down."""
    domes = domes_of(lambda t_s: triangle(t_s, peak_n, half_s), hysteresis=True)
    up_s = loads_n / peak_n * half_s
    up, down = kpa_at(domes, up_s), kpa_at(domes, (2 * half_s - up_s)[::-1])[::-1]
    return felt_n(up), felt_n(down)


def test_the_loop_closes_at_zero_load() -> None:
    domes = domes_of(triangle, hysteresis=True)
    assert domes.pressure_kpa(0, 0.0) == pytest.approx(100.0, abs=1e-12)
    np.testing.assert_allclose(kpa_at(domes, grid(4.0, 5.0, every=100)), 100.0, atol=1e-9)


def test_the_unloading_branch_lies_above_and_the_loop_is_as_wide_as_the_part_says() -> None:
    loads_n = np.linspace(1.0, 20.0, 20)
    up, down = loop(2.0, loads_n)
    width_n = down - up
    assert (width_n > 0).all()
    np.testing.assert_allclose((up + down) / 2, loads_n, atol=0.02)
    middle = width_n[np.searchsorted(loads_n, 15.0)]
    assert 0.75 * 2 * PART.loop_n < middle < 1.05 * 2 * PART.loop_n
    assert middle / 30.0 == pytest.approx(0.03, abs=0.006), "3 % of full scale, hardware.md 9"


def test_a_part_without_a_loop_shows_none() -> None:
    part = replace(PART, loop_n=0.0)
    t_s = grid(0.0, 4.0, every=50)
    kpa = kpa_at(domes_of(triangle, part, hysteresis=True), t_s)
    np.testing.assert_allclose(kpa, static_kpa(triangle(t_s)), atol=1e-9)


def test_the_loop_does_not_depend_on_the_speed() -> None:
    loads_n = np.array([2.0, 8.0, 15.0, 22.0])
    for slow, fast in zip(loop(4.0, loads_n), loop(0.5, loads_n), strict=True):
        np.testing.assert_allclose(slow, fast, atol=2e-5)


def test_a_held_load_stays_where_it_is_on_the_loop() -> None:
    hold = domes_of(lambda t_s: np.interp(t_s, [0, 1, 1.5], [0.0, 30.0, 15.0]), hysteresis=True)
    kpa = kpa_at(hold, grid(1.5, 4.0, every=100))
    np.testing.assert_allclose(kpa, kpa[0], atol=1e-12)
    assert kpa[0] > float(static_kpa(15.0)) + 0.05


def test_a_small_reversal_makes_a_smaller_loop_inside_the_large_one() -> None:
    loads_n = np.array([10.0])
    up, down = loop(2.0, loads_n)
    small_up, small_down = loop(2.0, loads_n, peak_n=11.0)
    assert small_up == pytest.approx(up)
    assert up[0] < small_down[0] < down[0]


# Repeatability


def pulses(t_s: Floats) -> Floats:
    """Loads of 20 N, half a second each, once a second."""
    phase = np.mod(t_s, 1.0)
    return np.interp(phase, [0.2, 0.25, 0.7, 0.75], [0.0, 20.0, 20.0, 0.0])


def peaks(loadings: int, **options: Any) -> Floats:
    """Volume lost in the middle of each loading, relative to what the load should take."""
    kpa = kpa_at(domes_of(pulses, **options), np.arange(loadings) + 0.5)
    v = PART.seal_kpa / (kpa * (1 + PART.wall_per_kpa * (kpa - PART.seal_kpa)))
    return np.asarray((1 - v) / float(lost(20.0)))


def test_without_repeatability_every_loading_is_the_same() -> None:
    np.testing.assert_allclose(peaks(5), 1.0, atol=1e-9)


def test_every_loading_draws_a_gain_of_its_own() -> None:
    gains = peaks(200, repeatability=0.03)
    assert len(np.unique(gains.round(9))) == 200
    # Standard error of a standard deviation from 200: 5 %
    assert gains.std(ddof=1) == pytest.approx(0.03, rel=0.2)
    assert gains.mean() == pytest.approx(1.0, abs=0.007)


def test_within_one_loading_the_gain_does_not_change() -> None:
    domes = domes_of(pulses, repeatability=0.03)
    kpa = kpa_at(domes, grid(2.3, 2.65, every=10))
    np.testing.assert_allclose(kpa, kpa[0], atol=1e-9)
    assert abs(kpa[0] - float(static_kpa(20.0))) > 0.01


def test_many_loadings_a_second_keep_their_gains_apart() -> None:
    def drumming(t_s: Floats) -> Floats:
        return pulses(t_s / 0.3)  # 0.15 s each, every 0.3 s: some last across a whole second

    domes = domes_of(drumming, repeatability=0.03)
    centres = 0.3 * (np.arange(20) + 0.475)
    early, late = (
        kpa_at(domes, centres - 0.06),
        kpa_at(domes_of(drumming, repeatability=0.03), centres + 0.06),
    )
    np.testing.assert_allclose(early, late, atol=1e-9)
    assert len(np.unique(early.round(6))) == 20


def test_gains_come_with_the_label_and_the_serial() -> None:
    first = peaks(5, repeatability=0.03, label="one")
    np.testing.assert_array_equal(first, peaks(5, repeatability=0.03, label="one"))
    assert (np.abs(first - peaks(5, repeatability=0.03, label="two")) > 1e-6).all()
    both = domes_of(pulses, PART, PART, repeatability=0.03)
    assert abs(both.pressure_kpa(0, 0.5) - both.pressure_kpa(1, 0.5)) > 1e-6


# Weather and mud


def test_the_baseline_follows_the_temperature_by_0_30_kpa_per_kelvin() -> None:
    # hardware.md 9: 0.335 for a rigid cavity, 0.30 with the give of Vytaflex 60
    def rise(**changes: Any) -> float:
        part = replace(PART, **changes)
        domes = domes_of(nothing, part, gas=True, temperature_step_k=4.0, temperature_step_s=1.0)
        assert domes.pressure_kpa(0, 1.0) == pytest.approx(100.0, abs=1e-6)
        return (domes.pressure_kpa(0, 60.0) - 100.0) / 4.0

    assert rise() == pytest.approx(0.30, abs=0.01)
    assert rise(wall_per_kpa=1e-9) == pytest.approx(0.335, abs=0.006)
    assert rise(wall_per_kpa=0.00389) == pytest.approx(0.24, abs=0.01)


def test_cold_lowers_the_baseline() -> None:
    domes = domes_of(nothing, temperature_step_k=-5.0)
    assert domes.pressure_kpa(0, 60.0) == pytest.approx(100.0 - 5 * 0.30, abs=0.05)


@pytest.mark.parametrize(("wall_per_kpa", "share"), [(0.00124, 0.11), (0.00389, 0.28)])
def test_a_head_of_water_raises_the_baseline_by_the_share_that_the_wall_lets_through(
    wall_per_kpa: float, share: float
) -> None:
    # hardware.md 9: 11 % for Vytaflex 60, 28 % for Vytaflex 40
    part = replace(PART, wall_per_kpa=wall_per_kpa)
    domes = domes_of(nothing, part, head_kpa=1.0, head_s=0.5)
    assert domes.pressure_kpa(0, 0.4995) == pytest.approx(100.0, abs=1e-9)
    assert domes.pressure_kpa(0, 0.5) - 100.0 == pytest.approx(share, abs=0.006)
    assert domes.pressure_kpa(0, 3.0) - 100.0 == pytest.approx(share, abs=0.006)


# The grid in time


def test_between_grid_points_the_pressure_is_linear() -> None:
    domes = domes_of(tap, **ALL)
    index = round(0.205 / GRID_S)
    low, high = kpa_at(domes, [index * GRID_S, (index + 1) * GRID_S])
    assert high - low > 0.1
    for part in (0.0, 0.25, 0.5, 0.9):
        assert domes.pressure_kpa(0, (index + part) * GRID_S) == pytest.approx(
            low + part * (high - low), abs=1e-9
        )


def test_the_physics_does_not_know_who_asks_or_when() -> None:
    often, seldom = domes_of(tap, **ALL), domes_of(tap, **ALL)
    for t in grid(0.0, 2.2, every=3):
        often.pressure_kpa(0, float(t))
    t_s = grid(1.6, 2.2)
    np.testing.assert_array_equal(kpa_at(seldom, t_s), kpa_at(often, t_s))


@pytest.mark.parametrize("shift_s", [0.3, 0.7895, 0.79, 0.7905])
def test_a_seam_between_blocks_does_not_show(shift_s: float) -> None:
    # At a shift of 0.79 the load ends its rise where the first block of one second ends.
    def shifted(t_s: Floats) -> Floats:
        return tap(t_s - shift_s)

    t_s = grid(0.2, 0.9)
    first = kpa_at(domes_of(tap, repeatability=0.03, **ALL), t_s)
    second = kpa_at(domes_of(shifted, repeatability=0.03, **ALL), t_s + shift_s)
    np.testing.assert_allclose(first, second, atol=1e-6)


def test_what_is_no_longer_kept_is_refused_and_not_invented() -> None:
    domes = domes_of(tap)
    domes.pressure_kpa(0, 10.0)
    domes.pressure_kpa(0, 9.0)
    with pytest.raises(ValueError, match="too late"):
        domes.pressure_kpa(0, 1.0)


def test_a_dome_does_not_feel_its_neighbours() -> None:
    other = replace(PART, seal_kpa=98.0, conduction_s=0.04, loop_n=0.35)
    t_s = grid(0.0, 0.8)
    alone = kpa_at(domes_of(tap, **ALL), t_s)
    beside = domes_of(tap, PART, other, **ALL)
    np.testing.assert_allclose(kpa_at(beside, t_s, dome=0), alone, atol=1e-6)
    swapped = domes_of(tap, other, PART, **ALL)
    np.testing.assert_allclose(kpa_at(swapped, t_s, dome=1), alone, atol=1e-6)


# A real clock


def test_computing_ahead_changes_no_pressure() -> None:
    def force(t_s: Floats) -> Floats:
        return np.where(t_s > 0.3, 8.0, 0.0)

    t_s = np.linspace(0.0, 2.5, 400)
    expected = kpa_at(domes_of(force, **ALL), t_s)
    ahead = domes_of(force, **ALL)
    got = []
    for t in t_s:
        ahead.foresee(float(t) + 0.4)
        got.append(ahead.pressure_kpa(0, float(t)))
    assert np.array(got).tobytes() == expected.tobytes()


def test_threads_that_ask_and_compute_ahead_at_once_see_the_same_pressures() -> None:
    def force(t_s: Floats) -> Floats:
        return np.where(t_s > 0.3, 8.0, 0.0)

    t_s = np.linspace(0.0, 4.0, 3000)
    expected = kpa_at(domes_of(force, **ALL), t_s)
    domes = domes_of(force, **ALL)
    ahead_of = [0.0]
    done = threading.Event()

    def look_ahead() -> None:
        while not done.is_set():
            domes.foresee(ahead_of[0] + 0.4)

    thread = threading.Thread(target=look_ahead)
    thread.start()
    got = []
    for t in t_s:
        ahead_of[0] = float(t)
        got.append(domes.pressure_kpa(0, float(t)))
    done.set()
    thread.join()
    assert np.array(got).tobytes() == expected.tobytes()
