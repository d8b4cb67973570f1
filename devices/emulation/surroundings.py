"""What is around the tiles: temperature, the weather's pressure, and the head of what they sink in.

A dome feels the head through the give of its wall alone, and the weather not at all: it was sealed
at some pressure, and a session is short. A bare reference tile feels both directly.
"""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np

from devices.arrays import Floats
from devices.emulation.parts import random_of
from devices.scene.emulated import EmulationScene

_WEATHER_KPA = (99.0, 101.0)
"""An ordinary day between sea level and 200 m (hardware.md 8: 1.17 kPa per 100 m)."""


class Submersion(Protocol):
    """How deep the tiles are in something heavy."""

    def head_kpa(self, t_s: Floats) -> Floats:
        """Hydrostatic pressure on each tile above the atmosphere's, (len(t_s), tiles)."""


class Surroundings:
    """Temperature and pressure around the tiles, and how chip and gas follow.

    One step of temperature, as the scene says; closed forms of one and two first-order lags.

    Args:
        scene: temperature, head and weather.
        submersion: what gives a head besides the scene's own, if anything.
        label: draws the weather where the scene does not give it.
    """

    def __init__(
        self, scene: EmulationScene, submersion: Submersion | None = None, label: str = ""
    ) -> None:
        self._scene = scene
        self._submersion = submersion
        drawn_kpa = random_of(f"weather/{label}").uniform(*_WEATHER_KPA)
        self.ambient_kpa = drawn_kpa if scene.ambient_kpa is None else scene.ambient_kpa
        """Pressure of the atmosphere, constant."""

    @property
    def steady(self) -> bool:
        """Does the temperature never change?"""
        return self._scene.temperature_step_k == 0.0

    def chip_degc(self, t_s: float, chip_lag_s: float, gas_lag_s: float) -> float:
        """Temperature of a chip: with one lag, or behind its gas with a second (`DomePart`)."""
        scene = self._scene
        since = max(t_s - scene.temperature_step_s, 0.0)
        if gas_lag_s < 0.0:
            return float(self._second_degc(np.array(since), chip_lag_s, -gas_lag_s))
        return scene.ambient_degc - scene.temperature_step_k * math.expm1(-since / chip_lag_s)

    def gas_wall_degc(self, t_s: Floats, chip_lag_s: float, gas_lag_s: float) -> Floats:
        """Temperature of the bubble's wall: behind its chip with a second lag, or before it."""
        scene = self._scene
        since = np.maximum(t_s - scene.temperature_step_s, 0.0)
        if gas_lag_s < 0.0:
            warmed_k = scene.temperature_step_k * np.expm1(-since / chip_lag_s)
            return np.asarray(scene.ambient_degc - warmed_k)
        return self._second_degc(since, chip_lag_s, gas_lag_s)

    def _second_degc(self, since: Floats, a: float, b: float) -> Floats:
        """Of what follows with lag `b` what follows the surroundings with lag `a`."""
        arrived = 1 - (a * np.exp(-since / a) - b * np.exp(-since / b)) / (a - b)
        return np.asarray(self._scene.ambient_degc + self._scene.temperature_step_k * arrived)

    def head_kpa(self, t_s: Floats) -> Floats:
        """Pressure around each tile above the atmosphere's.

        Returns:
            (len(t_s), tiles), or (len(t_s), 1) where it is the same for all.
        """
        own_kpa = np.where(t_s >= self._scene.head_s, self._scene.head_kpa, 0.0)[:, None]
        return own_kpa if self._submersion is None else own_kpa + self._submersion.head_kpa(t_s)

    def bare_kpa(self, t_s: Floats) -> Floats:
        """What tiles without a dome would sense: the atmosphere and the head on each.

        Returns:
            As `head_kpa`.
        """
        return self.ambient_kpa + self.head_kpa(t_s)
