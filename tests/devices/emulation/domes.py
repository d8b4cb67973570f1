"""Domes under a force that a test draws."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
from hypothesis import strategies as st

from devices.emulation.dome_physics import GRID_S, Domes
from devices.emulation.parts import DomeProperties
from devices.emulation.surroundings import Surroundings
from devices.scene.emulation_sections import EmulationSection

Floats = npt.NDArray[np.float64]
Force = Callable[[Floats], Floats]

PART = DomeProperties(
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


class Pressing:
    """A force as a function of time, equal on every dome."""

    def __init__(self, force: Force, domes: int) -> None:
        self._force = force
        self._domes = domes

    def forces_n(self, t_s: Floats) -> Floats:
        return np.repeat(self._force(np.asarray(t_s))[:, None], self._domes, axis=1)


def no_force(t_s: Floats) -> Floats:
    return np.zeros_like(t_s)


def domes_of(
    force: Force = no_force,
    *parts: DomeProperties,
    label: str = "test",
    in_real_time: bool = False,
    **effects: Any,
) -> Domes:
    """Return domes under a force, with the named effects only."""
    scene = EmulationSection(**({"gas": False, "rubber": False, "hysteresis": False} | effects))
    parts = parts or (PART,)
    serials = [f"S{i}" for i in range(len(parts))]
    load = Pressing(force, len(parts))
    around = Surroundings(scene)
    return Domes(parts, serials, load, scene, around, label=label, in_real_time=in_real_time)


def kpa_at(domes: Domes, t_s: npt.ArrayLike, dome: int = 0) -> Floats:
    return np.array([domes.compute_pressure_kpa(dome, float(t)) for t in np.asarray(t_s)])


def grid(begin_s: float, end_s: float, every: int = 1) -> Floats:
    """Return grid points, between which the emulation is linear."""
    steps = np.arange(round(begin_s / GRID_S), round(end_s / GRID_S) + 1, every)
    return np.asarray(steps * GRID_S, dtype=np.float64)


def lost(force_n: npt.ArrayLike, part: DomeProperties = PART) -> Floats:
    """Return the part of the bubble's volume that a slow force takes."""
    return np.asarray(part.stiffening * np.log1p(np.asarray(force_n) / part.knee_n))


def static_kpa(force_n: npt.ArrayLike, part: DomeProperties = PART) -> Floats:
    """Return the positive root of p (1 + c (p - seal)) (1 - lost) = seal."""
    c, seal = part.wall_per_kpa, part.seal_kpa
    v = 1 - lost(force_n, part)
    b = 1 - c * seal
    return np.asarray((-b + np.sqrt(b * b + 4 * c * seal / v)) / (2 * c))


def static_force_n(kpa: Floats, part: DomeProperties = PART) -> Floats:
    """Return the static force of this pressure."""
    v = part.seal_kpa / (kpa * (1 + part.wall_per_kpa * (kpa - part.seal_kpa)))
    return np.asarray(part.knee_n * np.expm1((1 - v) / part.stiffening))


def ramp(begin_s: float, end_s: float, to_n: float) -> Force:
    return lambda t_s: np.interp(t_s, [begin_s, end_s], [0.0, to_n])


parts = st.builds(
    DomeProperties,
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
