"""The hysteresis loop of a dome, and the gain of each loading."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests.devices.emulation.domes import (
    PART,
    Floats,
    domes_of,
    grid,
    kpa_at,
    lost,
    static_force_n,
    static_kpa,
)

# Gain


def test_the_gain_drifts_for_each_dome_differently() -> None:
    def gains(label: str, gain_drift: float) -> Floats:
        domes = domes_of(
            np.ones_like, *[PART] * 40, label=label, gain_drift=gain_drift, hysteresis=False
        )
        kpa = [domes.compute_pressure_kpa(dome, 0.1) for dome in range(40)]
        volume = 100.0 / (np.array(kpa) * (1 + PART.wall_per_kpa * (np.array(kpa) - 100.0)))
        return np.asarray((1 - volume) / lost(1.0))

    drifted = gains("Tuesday", 0.01)
    assert 0.99 <= drifted.min() < 0.993
    assert 1.007 < drifted.max() <= 1.01
    assert len(set(drifted.tolist())) == 40
    assert gains("Tuesday", 0.01).tolist() == drifted.tolist()
    assert gains("Wednesday", 0.01).tolist() != drifted.tolist()
    np.testing.assert_allclose(gains("Tuesday", 0.0), 1.0, atol=1e-9)


# Hysteresis

VISCOUS = replace(PART, loop_n=0.0, viscous_n=0.4)


def triangle(t_s: Floats, peak_n: float = 30.0, half_s: float = 2.0) -> Floats:
    return np.interp(t_s, [0, half_s, 2 * half_s], [0.0, peak_n, 0.0])


def loop(half_s: float, loads_n: Floats, peak_n: float = 30.0) -> tuple[Floats, Floats]:
    """Return static forces at the same loads on the way up and on the way down."""
    domes = domes_of(lambda t_s: triangle(t_s, peak_n, half_s), hysteresis=True)
    up_s = loads_n / peak_n * half_s
    up, down = kpa_at(domes, up_s), kpa_at(domes, (2 * half_s - up_s)[::-1])[::-1]
    return static_force_n(up), static_force_n(down)


def test_the_loop_closes_at_zero_load() -> None:
    domes = domes_of(triangle, hysteresis=True)
    assert domes.compute_pressure_kpa(0, 0.0) == pytest.approx(100.0, abs=1e-12)
    np.testing.assert_allclose(kpa_at(domes, grid(4.0, 5.0, every=100)), 100.0, atol=1e-9)


def test_the_unloading_branch_lies_above_and_the_loop_has_the_width_of_the_part() -> None:
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


def viscous_width_n(half_s: float, at_n: float) -> float:
    """Return the width of the viscous loop of a triangle of 30 N."""
    domes = domes_of(lambda t_s: triangle(t_s, 30.0, half_s), VISCOUS, hysteresis=True)
    up_s = at_n / 30.0 * half_s
    up, down = static_force_n(kpa_at(domes, [up_s, 2 * half_s - up_s]))
    return float(down - up)


def test_the_viscous_loop_of_a_slow_stroke_has_the_width_of_the_part() -> None:
    assert viscous_width_n(4.0, 20.0) == pytest.approx(2 * 0.4, rel=0.05)


def test_the_viscous_loop_grows_with_a_low_power_of_the_speed() -> None:
    # In steady flow the rate is stress to the fourth.
    slow, fast = viscous_width_n(8.0, 15.0), viscous_width_n(0.5, 15.0)
    assert fast / slow == pytest.approx(16 ** (1 / 4), rel=0.1)


@pytest.mark.parametrize(("part", "power"), [(0.08, 4.0), (0.12, 3.0), (0.04, 5.7)])
def test_viscous_flow_obeys_its_equation_under_any_load(part: float, power: float) -> None:
    def force(t: float) -> float:
        return 8.0 * math.sin(3.0 * t) ** 2 + 6.0 * math.sin(11.0 * t) ** 2

    def rate(t: float, s: Floats) -> Floats:
        force_n_s = 24.0 * math.sin(6.0 * t) + 66.0 * math.sin(22.0 * t)
        return np.asarray(part * (force_n_s - 7.5 * np.sign(s) * np.abs(s / 0.4) ** power))

    t_s = grid(0.0, 2.0, every=20)
    solved = solve_ivp(rate, (0.0, 2.0), [0.0], "LSODA", t_s, rtol=1e-9, atol=1e-10, max_step=1e-3)
    load = np.array([force(t) for t in t_s])
    dome = replace(VISCOUS, flow_part=part, flow_power=power)
    domes = domes_of(lambda t_s: np.array([force(t) for t in t_s]), dome, hysteresis=True)
    np.testing.assert_allclose(
        static_force_n(kpa_at(domes, t_s), dome), np.maximum(load - solved.y[0], 0.0), atol=2e-3
    )


def test_the_viscous_residue_fades_and_the_dome_never_pulls() -> None:
    domes = domes_of(lambda t_s: np.interp(t_s, [1, 1.005], [20.0, 0.0]), VISCOUS, hysteresis=True)
    felt = static_force_n(kpa_at(domes, grid(1.005, 9.0, every=20)), VISCOUS)
    assert 0.5 < felt[0] <= 0.08 * 20.0
    assert (np.diff(felt) < 1e-9).all()
    assert 0.0 < felt[-1] < 0.25


def test_domes_with_and_without_viscosity_stand_beside_one_another() -> None:
    t_s = grid(0.0, 4.0, every=40)
    for dome, part in enumerate((PART, VISCOUS)):
        both = domes_of(triangle, PART, VISCOUS, hysteresis=True)
        alone = domes_of(triangle, part, hysteresis=True)
        np.testing.assert_allclose(kpa_at(both, t_s, dome), kpa_at(alone, t_s), atol=1e-9)


def test_a_constant_load_keeps_its_place_on_the_loop() -> None:
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
    """Return the relative gain in the middle of each loading."""
    kpa = kpa_at(domes_of(pulses, **options), np.arange(loadings) + 0.5)
    v = PART.seal_kpa / (kpa * (1 + PART.wall_per_kpa * (kpa - PART.seal_kpa)))
    return np.asarray((1 - v) / float(lost(20.0)))


def test_every_loading_draws_a_gain_of_its_own_by_the_repeatability() -> None:
    np.testing.assert_allclose(peaks(5), 1.0, atol=1e-9)
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
    assert abs(both.compute_pressure_kpa(0, 0.5) - both.compute_pressure_kpa(1, 0.5)) > 1e-6
