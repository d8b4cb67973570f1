"""What is around the tiles, as chips, gas and bare reference tiles feel it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.integrate import solve_ivp

from devices.emulation.surroundings import Surroundings
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
    # The other way round: the chip is further from the surroundings than its gas.
    gas = surroundings.compute_gas_wall_degc(t_s, 1.0, -4.0)
    np.testing.assert_allclose(gas, solved.y[0], atol=0.05)
    chip = [surroundings.compute_chip_degc(float(t), 1.0, -4.0) for t in t_s]
    np.testing.assert_allclose(chip, solved.y[1], atol=0.05)
    assert not surroundings.is_temperature_constant
    assert Surroundings(EmulationSection()).is_temperature_constant


def test_an_ordinary_day_has_an_ordinary_pressure_of_its_own() -> None:
    drawn = [Surroundings(EmulationSection(), label=str(day)).ambient_kpa for day in range(200)]
    assert 99.0 <= min(drawn) < 99.2
    assert 100.8 < max(drawn) <= 101.0
    assert Surroundings(EmulationSection(), label="7").ambient_kpa == drawn[7]


def test_a_scene_can_say_what_the_weather_is() -> None:
    # hardware.md 9: ISA at 1000 m
    assert Surroundings(EmulationSection(ambient_kpa=89.9)).ambient_kpa == 89.9


def test_a_bare_tile_senses_the_atmosphere_and_all_of_the_head_on_it() -> None:
    scene = EmulationSection(ambient_kpa=100.0, head_kpa=0.5, head_s=2.0)
    sunk = Surroundings(scene, Sinking())
    t_s = np.array([1.0, 3.0])
    np.testing.assert_allclose(sunk.compute_bare_kpa(t_s), [[101.0, 102.0], [103.5, 106.5]])
    np.testing.assert_allclose(Surroundings(scene).compute_bare_kpa(t_s), [[100.0], [100.5]])


def test_the_head_on_each_tile_is_its_own() -> None:
    heads = Surroundings(EmulationSection(), Sinking()).compute_head_kpa(np.array([0.0, 1.0]))
    np.testing.assert_allclose(heads, [[0.0, 0.0], [1.0, 2.0]])
