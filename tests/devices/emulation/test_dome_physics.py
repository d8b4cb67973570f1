"""The emulated dome against its own laws: statics, creep, weather, and its grid in time.

Expectations come from physics worked out here (exponentials, two lags in series) and from
hardware.md 9, not from the emulation's own numbers.
"""

from __future__ import annotations

import functools
import math
from dataclasses import replace
from typing import Any, Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.emulation import dome_physics
from devices.emulation.dome_physics import GRID_S
from devices.emulation.parts import DomeProperties, draw_family_dome
from tests.devices.emulation.domes import (
    PART,
    Floats,
    domes_of,
    grid,
    kpa_at,
    no_force,
    parts,
    ramp,
    static_force_n,
    static_kpa,
)

ALL: dict[str, Any] = {"gas": True, "rubber": True, "hysteresis": True}


@settings(max_examples=25, deadline=None)
@given(part=parts, force_n=st.floats(0, 60))
def test_without_effects_the_pressure_obeys_the_static_law(
    part: DomeProperties, force_n: float
) -> None:
    p = domes_of(lambda t_s: np.full_like(t_s, force_n), part).compute_pressure_kpa(0, 0.1)
    volume = 1 - part.stiffening * math.log(1 + force_n / part.knee_n)
    assert p * (1 + part.wall_per_kpa * (p - part.seal_kpa)) * volume == pytest.approx(
        part.seal_kpa, rel=1e-12
    )


def test_an_unloaded_dome_keeps_the_pressure_it_was_sealed_at() -> None:
    t_s = grid(0.0, 3.0, every=100)
    np.testing.assert_allclose(kpa_at(domes_of(no_force, **ALL), t_s), 100.0, atol=1e-9)


def test_the_static_curve_is_concave_and_rises_to_the_end_of_the_range() -> None:
    force_n = np.linspace(0, 60, 121)
    kpa = kpa_at(domes_of(ramp(0.0, 1.2, 60.0)), force_n * 0.02)
    assert (np.diff(kpa) > 0).all()
    assert (np.diff(kpa, 2) < 0).all()


@pytest.mark.parametrize("force_n", [1.0, 15.0, 40.0])
def test_a_constant_load_with_every_effect_ends_at_the_static_law(force_n: float) -> None:
    domes = domes_of(ramp(0.5, 2.0, force_n), gas=True, rubber=True)
    # Ten times the slowest term of creep
    assert domes.compute_pressure_kpa(0, 22.0) == pytest.approx(
        float(static_kpa(force_n)), abs=1e-3
    )


# Each effect can be switched off


def tap(t_s: Floats) -> Floats:
    """Return a load of 20 N from 0.2 s to 0.5 s, with ramps of 10 ms."""
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


# Creep


@pytest.mark.parametrize(
    ("creep_parts", "creep_s"),
    [
        (PART.creep_parts, PART.creep_s),
        ((), ()),
        ((0.1,), (0.01,)),
        ((0.05, 0.04, 0.03, 0.03), (0.01, 0.1, 1.0, 10.0)),
    ],
)
def test_creep_is_the_sum_of_its_exponentials(
    creep_parts: tuple[float, ...], creep_s: tuple[float, ...]
) -> None:
    begin_s = 0.3
    step = ramp(begin_s - GRID_S, begin_s, 20.0)
    t_s = grid(begin_s, 6.0, every=20)
    part = replace(PART, creep_parts=creep_parts, creep_s=creep_s)
    felt = static_force_n(kpa_at(domes_of(step, part, rubber=True), t_s))
    missing = sum(
        share * np.exp(-(t_s - begin_s + GRID_S / 2) / tau_s)
        for share, tau_s in zip(creep_parts, creep_s, strict=True)
    )
    np.testing.assert_allclose(felt, 20.0 * (1 - missing), atol=5e-4)


def test_rubber_relaxes_slowly_after_a_release_and_never_pulls() -> None:
    domes = domes_of(lambda t_s: np.interp(t_s, [10, 10.001], [20.0, 0.0]), rubber=True)
    kpa = kpa_at(domes, grid(10.001, 30.0, every=200))
    assert kpa[0] == pytest.approx(float(static_kpa(20.0 * 0.09)), abs=0.05)
    assert (np.diff(kpa) < 1e-12).all()
    assert (kpa > 100.0).all()
    assert kpa[-1] == pytest.approx(100.0, abs=0.01)


# Weather and mud


def test_the_baseline_follows_the_temperature_by_0_30_kpa_per_kelvin() -> None:
    # hardware.md 9: 0.335 for a rigid cavity, 0.30 with the give of Vytaflex 60
    def rise(step_k: float = 4.0, gas: bool = True, **changes: Any) -> float:
        part = replace(PART, **changes)
        domes = domes_of(no_force, part, gas=gas, temperature_step_k=step_k, temperature_step_s=1.0)
        assert domes.compute_pressure_kpa(0, 1.0) == pytest.approx(100.0, abs=1e-6)
        return (domes.compute_pressure_kpa(0, 60.0) - 100.0) / step_k

    assert rise() == pytest.approx(0.30, abs=0.01)
    assert rise(-5.0, gas=False) == pytest.approx(0.30, abs=0.01)
    assert rise(wall_per_kpa=1e-9) == pytest.approx(0.335, abs=0.006)
    assert rise(wall_per_kpa=0.00389) == pytest.approx(0.24, abs=0.01)


@pytest.mark.parametrize(("wall_per_kpa", "share"), [(0.00124, 0.11), (0.00389, 0.28)])
def test_a_head_of_water_raises_the_baseline_by_the_share_of_the_wall(
    wall_per_kpa: float, share: float
) -> None:
    # hardware.md 9: 11 % for Vytaflex 60, 28 % for Vytaflex 40
    part = replace(PART, wall_per_kpa=wall_per_kpa)
    domes = domes_of(no_force, part, head_kpa=1.0, head_s=0.5)
    assert domes.compute_pressure_kpa(0, 0.4995) == pytest.approx(100.0, abs=1e-9)
    assert domes.compute_pressure_kpa(0, 0.5) - 100.0 == pytest.approx(share, abs=0.006)
    assert domes.compute_pressure_kpa(0, 3.0) - 100.0 == pytest.approx(share, abs=0.006)


# The grid in time


def test_between_grid_points_the_pressure_is_linear() -> None:
    domes = domes_of(tap, **ALL)
    index = round(0.205 / GRID_S)
    low, high = kpa_at(domes, [index * GRID_S, (index + 1) * GRID_S])
    assert high - low > 0.1
    for part in (0.0, 0.25, 0.5, 0.9):
        assert domes.compute_pressure_kpa(0, (index + part) * GRID_S) == pytest.approx(
            low + part * (high - low), abs=1e-9
        )


def test_the_pressure_does_not_depend_on_earlier_calls() -> None:
    often, seldom = domes_of(tap, **ALL), domes_of(tap, **ALL)
    for t in grid(0.0, 2.2, every=3):
        often.compute_pressure_kpa(0, float(t))
    t_s = grid(1.6, 2.2)
    np.testing.assert_array_equal(kpa_at(seldom, t_s), kpa_at(often, t_s))


@pytest.mark.parametrize("shift_s", [0.3, 0.7895, 0.79, 0.7905])
def test_a_seam_between_pieces_does_not_show(shift_s: float) -> None:
    # At a shift of 0.79 the load ends its rise where a piece ends.
    def shifted(t_s: Floats) -> Floats:
        return tap(t_s - shift_s)

    t_s = grid(0.2, 0.9)
    first = kpa_at(domes_of(tap, repeatability=0.03, **ALL), t_s)
    second = kpa_at(domes_of(shifted, repeatability=0.03, **ALL), t_s + shift_s)
    np.testing.assert_allclose(first, second, atol=1e-6)


def test_a_pressure_of_long_ago_is_refused() -> None:
    domes = domes_of(tap)
    domes.compute_pressure_kpa(0, 10.0)
    domes.compute_pressure_kpa(0, 9.0)
    with pytest.raises(ValueError, match="too late"):
        domes.compute_pressure_kpa(0, 1.0)


def test_a_dome_does_not_depend_on_its_neighbours() -> None:
    other = replace(PART, seal_kpa=98.0, conduction_s=0.04, loop_n=0.35)
    t_s = grid(0.0, 0.8)
    alone = kpa_at(domes_of(tap, **ALL), t_s)
    beside = domes_of(tap, PART, other, **ALL)
    np.testing.assert_allclose(kpa_at(beside, t_s, dome=0), alone, atol=1e-6)
    swapped = domes_of(tap, other, PART, **ALL)
    np.testing.assert_allclose(kpa_at(swapped, t_s, dome=1), alone, atol=1e-6)


# When it is computed


@pytest.mark.parametrize("family", ["default", "broad"])
def test_the_bits_do_not_depend_on_the_size_of_pieces(
    family: Literal["default", "broad"], monkeypatch: pytest.MonkeyPatch
) -> None:
    part = draw_family_dome(family, "T01", 0)
    everything: dict[str, Any] = ALL | {"repeatability": 0.03, "temperature_step_k": -4.0}
    for points, until_s in ((1, 0.3), (7, 2.2), (4000, 2.2)):
        t_s = grid(0.0, until_s)
        monkeypatch.undo()
        expected = kpa_at(domes_of(tap, part, **everything), t_s)
        monkeypatch.setattr(dome_physics, "_CHUNK_POINTS", points)
        assert kpa_at(domes_of(tap, part, **everything), t_s).tobytes() == expected.tobytes()


def rising(t_s: Floats) -> Floats:
    """Return a load that differs at every instant."""
    return 0.2 * np.asarray(t_s)


BESIDE_GAS: dict[str, Any] = {"rubber": True, "gas": True}


@functools.cache
def rising_kpa() -> Floats:
    """Return pressures at every grid point, by a driver that is never late."""
    return kpa_at(domes_of(rising, **BESIDE_GAS), grid(0.0, 60.0))


@settings(max_examples=15, deadline=None)
@given(
    pauses_s=st.lists(st.floats(0.0, 9.0), min_size=1, max_size=6),
    back_s=st.lists(st.floats(0.0, 0.9), min_size=6, max_size=6),
    in_real_time=st.booleans(),
)
def test_a_late_driver_reads_the_pressure_of_its_instant(
    pauses_s: list[float], back_s: list[float], in_real_time: bool
) -> None:
    domes = domes_of(rising, in_real_time=in_real_time, **BESIDE_GAS)
    t_s = 0.0
    for pause_s, before_s in zip(pauses_s, back_s, strict=False):
        t_s += pause_s
        for asked_s in (t_s, max(0.0, t_s - before_s)):
            point = round(asked_s / GRID_S)
            assert domes.compute_pressure_kpa(0, point * GRID_S) == pytest.approx(
                rising_kpa()[point], abs=1e-12
            )


def test_the_stored_past_is_bounded() -> None:
    domes = domes_of(rising)
    for t_s in range(20):
        domes.compute_pressure_kpa(0, float(t_s))
    assert sum(len(piece) for piece in domes._chunks.values()) < 2 / GRID_S


@pytest.mark.parametrize("late_s", [2.0, 12.5, 55.5])
def test_a_driver_reads_the_present_pressure_after_a_long_pause(late_s: float) -> None:
    points = [0]

    def pressed(t_s: Floats) -> Floats:
        """Return 20 N and 0 N in turn, three seconds each, and 0 N in the last three."""
        points[0] += len(t_s)
        return np.where(np.mod(t_s - late_s, 6.0) < 3.0, 0.0, 20.0)

    present = domes_of(pressed, **ALL)
    present_kpa = kpa_at(present, grid(0.0, late_s))[-1]
    away = domes_of(pressed, in_real_time=True, **ALL)
    points[0] = 0
    assert away.compute_pressure_kpa(0, late_s) == pytest.approx(present_kpa, abs=0.05)
    assert points[0] < 12 / GRID_S, "not all of the past is computed"
    assert away.compute_pressure_kpa(0, late_s - 0.9) == pytest.approx(
        present.compute_pressure_kpa(0, late_s - 0.9), abs=0.05
    )
