"""Surroundings of the tiles: temperature, atmosphere, head, and a hole in a dome."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import pytest
from scipy.integrate import solve_ivp

from devices.emulation.fault_timing import FaultTiming
from devices.emulation.surroundings import Puncture, Surroundings
from devices.scene.emulation_sections import EmulationSection

Floats = npt.NDArray[np.float64]


class Sinking:
    """Two tiles that sink, one twice as deep as the other."""

    def compute_head_kpa(self, t_s: Floats) -> Floats:
        return np.outer(t_s, [1.0, 2.0])


def test_chip_and_gas_follow_the_surroundings_with_one_and_two_lags() -> None:
    scene = EmulationSection(ambient_degc=20.0, temperature_step_k=8.0, temperature_step_s=2.0)
    surroundings = Surroundings(scene)
    t_s = np.linspace(0, 20, 81)

    def lags(t: float, state: Floats) -> list[float]:
        outside = 28.0 if t >= 2.0 else 20.0
        return [(outside - state[0]) / 1.0, (state[0] - state[1]) / 4.0]

    solved = solve_ivp(lags, (0, 20), [20.0, 20.0], t_eval=t_s, rtol=1e-8, max_step=0.02)
    chip = [surroundings.compute_chip_degc(float(t), 1.0, 4.0) for t in t_s]
    np.testing.assert_allclose(chip, solved.y[0], atol=0.05)
    gas = surroundings.compute_gas_wall_degc(t_s, 1.0, 4.0)
    np.testing.assert_allclose(gas, solved.y[1], atol=0.05)
    # A negative lag: the chip follows its gas.
    gas = surroundings.compute_gas_wall_degc(t_s, 1.0, -4.0)
    np.testing.assert_allclose(gas, solved.y[0], atol=0.05)
    chip = [surroundings.compute_chip_degc(float(t), 1.0, -4.0) for t in t_s]
    np.testing.assert_allclose(chip, solved.y[1], atol=0.05)
    assert not surroundings.is_temperature_constant
    assert Surroundings(EmulationSection()).is_temperature_constant


def test_a_day_has_its_own_pressure_unless_the_scene_gives_it() -> None:
    drawn = [Surroundings(EmulationSection(), label=str(day)).ambient_kpa for day in range(200)]
    assert 99.0 <= min(drawn) < 99.2
    assert 100.8 < max(drawn) <= 101.0
    assert Surroundings(EmulationSection(), label="7").ambient_kpa == drawn[7]
    # hardware.md 9: ISA at 1000 m
    assert Surroundings(EmulationSection(ambient_kpa=89.9)).ambient_kpa == 89.9


def test_a_bare_tile_reads_the_atmosphere_and_its_head() -> None:
    scene = EmulationSection(ambient_kpa=100.0, head_kpa=0.5, head_s=2.0)
    sunk = Surroundings(scene, Sinking())
    t_s = np.array([1.0, 3.0])
    np.testing.assert_allclose(sunk.compute_bare_kpa(t_s), [[101.0, 102.0], [103.5, 106.5]])
    np.testing.assert_allclose(Surroundings(scene).compute_bare_kpa(t_s), [[100.0], [100.5]])
    heads = Surroundings(EmulationSection(), Sinking()).compute_head_kpa(np.array([0.0, 1.0]))
    np.testing.assert_allclose(heads, [[0.0, 0.0], [1.0, 2.0]])


# A dome with a hole

STEP_S = 0.001


def press(leak: Puncture, sealed_kpa: float, begin_s: float, seconds: float) -> float:
    """Return the pressure at the end of a load that gives `sealed_kpa` in an intact dome."""
    steps = round(seconds / STEP_S)
    kpa = math.nan
    for i in range(1, steps + 1):
        t_s = begin_s + i * STEP_S
        kpa = leak.apply_leak(sealed_kpa, t_s, round(t_s * 1e9))
    return kpa


def test_an_intact_dome_keeps_its_gas() -> None:
    assert press(Puncture(FaultTiming(), 0.1, 100.0), 110.0, 0.0, 2.0) == 110.0


def test_the_pressure_difference_falls_to_1_e_in_the_time_of_the_leak() -> None:
    leak = Puncture(FaultTiming([(0.0, 100.0)]), 2.0, 100.0)
    # Of a bubble that is hardly squeezed: 2 s; one at 110 kPa has 100/110 of that time.
    assert press(leak, 110.0, 0.0, 2.0 / 1.1) - 100.0 == pytest.approx(10.0 / math.e, rel=1e-3)


def test_lost_gas_is_missing_after_the_load_and_returns() -> None:
    leak = Puncture(FaultTiming([(0.0, 100.0)]), 0.5, 100.0)
    assert press(leak, 110.0, 0.0, 5.0) == pytest.approx(100.0, abs=0.01)
    assert leak.apply_leak(100.0, 5.0, 5_000_000_000) == pytest.approx(100.0 / 1.1, abs=0.01)
    assert press(leak, 100.0, 5.0, 5.0) == pytest.approx(100.0, abs=0.01)


def test_a_repaired_dome_is_sealed_with_its_remaining_gas() -> None:
    hole = FaultTiming([(0.0, 1.0)])
    hole.begin_scene_time(0)
    leak = Puncture(hole, 0.5, 100.0)
    remaining = press(leak, 110.0, 0.0, 0.99)
    assert remaining < 103.0
    assert press(leak, 110.0, 1.0, 5.0) == pytest.approx(remaining, abs=0.02)
    assert press(leak, 100.0, 6.0, 5.0) == pytest.approx(remaining / 1.1, abs=0.02)
