"""Surroundings of the tiles: temperature, atmospheric pressure, water; sites of chips, and leaks.

The head of water affects a dome through the compliance of its wall only, and the weather not at
all: it is sealed, and a session is short. Head and weather affect a bare reference tile directly.

The leak is a capillary, like a crack or a bad seam: the flow is proportional to the pressure
difference over the wall. It equalises in some hundredths of a second through a needle's hole, in
minutes through a pore. The lost gas is missing afterwards: unloaded, the dome reads less than its
surroundings until air has returned. A dome open for long follows the weather, and no temperature.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol

import numpy as np

from devices.arrays import Floats
from devices.emulation.fault_timing import FaultTiming
from devices.emulation.parts import make_rng
from devices.scene.emulation_sections import EmulationSection

_WEATHER_KPA = (99.0, 101.0)
"""Range on ordinary days between sea level and 200 m (hardware.md 8: 1.17 kPa per 100 m)."""


class Submersion(Protocol):
    """Submersion of the tiles in a heavy medium."""

    def compute_head_kpa(self, t_s: Floats) -> Floats:
        """Compute the head on each tile above atmospheric pressure, (len(t_s), tiles)."""


class Surroundings:
    """Temperature and pressure around the tiles, and the delayed temperatures of chip and gas.

    One step of temperature, from the scene; closed forms of one and two first-order lags.

    Args:
        scene: temperature, head and weather.
        submersion: source of a head in addition to the scene's; None: no such source.
        label: seed of the weather if the scene does not give it.
    """

    def __init__(
        self, scene: EmulationSection, submersion: Submersion | None = None, label: str = ""
    ) -> None:
        self._scene = scene
        self._submersion = submersion
        drawn_kpa = make_rng(f"weather/{label}").uniform(*_WEATHER_KPA)
        self.ambient_kpa = drawn_kpa if scene.ambient_kpa is None else scene.ambient_kpa
        """Pressure of the atmosphere, constant."""

    @property
    def is_temperature_constant(self) -> bool:
        """True if the temperature never changes."""
        return self._scene.temperature_step_k == 0.0

    def compute_chip_degc(self, t_s: float, chip_lag_s: float, gas_lag_s: float) -> float:
        """Compute a chip's temperature: one lag, or one more behind its gas (`DomeProperties`)."""
        scene = self._scene
        since = max(t_s - scene.temperature_step_s, 0.0)
        if gas_lag_s < 0.0:
            return float(self._compute_two_lag_degc(np.array(since), chip_lag_s, -gas_lag_s))
        return scene.ambient_degc - scene.temperature_step_k * math.expm1(-since / chip_lag_s)

    def compute_gas_wall_degc(self, t_s: Floats, chip_lag_s: float, gas_lag_s: float) -> Floats:
        """Compute the bubble wall's temperature: one lag, or a second one behind its chip."""
        scene = self._scene
        since = np.maximum(t_s - scene.temperature_step_s, 0.0)
        if gas_lag_s < 0.0:
            warmed_k = scene.temperature_step_k * np.expm1(-since / chip_lag_s)
            return np.asarray(scene.ambient_degc - warmed_k)
        return self._compute_two_lag_degc(since, chip_lag_s, gas_lag_s)

    def _compute_two_lag_degc(self, since: Floats, a: float, b: float) -> Floats:
        """Compute a temperature behind the surroundings with two lags, `a` and `b`, in series."""
        arrived = 1 - (a * np.exp(-since / a) - b * np.exp(-since / b)) / (a - b)
        return np.asarray(self._scene.ambient_degc + self._scene.temperature_step_k * arrived)

    def compute_head_kpa(self, t_s: Floats) -> Floats:
        """Compute the head around each tile, above atmospheric pressure.

        Returns:
            (len(t_s), tiles), or (len(t_s), 1) if it is the same for all.
        """
        own_kpa = np.where(t_s >= self._scene.head_s, self._scene.head_kpa, 0.0)[:, None]
        return (
            own_kpa
            if self._submersion is None
            else own_kpa + self._submersion.compute_head_kpa(t_s)
        )

    def compute_bare_kpa(self, t_s: Floats) -> Floats:
        """Compute the pressure on tiles without a dome: atmosphere and head.

        Returns:
            As `compute_head_kpa`.
        """
        return self.ambient_kpa + self.compute_head_kpa(t_s)


class Puncture:
    """Leak of one dome; after the fault it is sealed with the remaining gas.

    Args:
        fault: fault during which the gas leaks.
        leak_s: time constant of the pressure difference of an unloaded bubble.
        around_kpa: pressure of the atmosphere.
    """

    def __init__(self, fault: FaultTiming, leak_s: float, around_kpa: float) -> None:
        self._fault = fault
        self._leak_s = leak_s
        self._around_kpa = around_kpa
        self._remaining_gas = 1.0  # amount of gas, relative to what was sealed in
        self._last_s = 0.0

    def apply_leak(self, sealed_kpa: float, t_s: float, t_ns: int) -> float:
        """Compute the absolute pressure with the leak, and update the remaining gas.

        The load is taken as constant between two calls: a chip samples every few milliseconds.

        Args:
            sealed_kpa: absolute pressure without the leak.
            t_s: time of the scene, never decreasing.
            t_ns: the same instant of the clock.
        """
        if not self._fault.is_possible:
            return sealed_kpa
        if self._fault(t_ns):
            # At constant volume the amount relaxes to its value at outer pressure, faster under
            # load.
            even = self._around_kpa / sealed_kpa
            kept = math.exp(-max(0.0, t_s - self._last_s) / (self._leak_s * even))
            self._remaining_gas = even + (self._remaining_gas - even) * kept
        self._last_s = t_s
        return self._remaining_gas * sealed_kpa


_FAR_OVER_RANGE_KPA = 45.0


class ChipSite:
    """Site of one chip, in a dome or bare.

    Before `begin_scene_time` it is at the scene's first instant. Fault `over_range`: pressure is
    45 kPa higher, past the range of most chips.

    Args:
        pressure_kpa: pressure at a time of the scene.
        lags_s: time constants of chip and gas behind the surroundings.
        surroundings: temperature around the foot.
        emulation: section of the scene.
        noise_label: seed of the chip's noise.
        over_range: timing of the fault.
        frozen: likewise.
        puncture: leak of the dome.
    """

    def __init__(
        self,
        pressure_kpa: Callable[[float], float],
        lags_s: tuple[float, float],
        surroundings: Surroundings,
        emulation: EmulationSection,
        noise_label: str,
        *,
        over_range: FaultTiming | None = None,
        frozen: FaultTiming | None = None,
        puncture: Puncture | None = None,
    ) -> None:
        self.emulation = emulation
        self.noise_label = noise_label
        self.is_frozen = frozen if frozen is not None else FaultTiming()
        """Fault of a constant pressure, at an instant of the clock."""
        self.is_temperature_constant = surroundings.is_temperature_constant
        self._pressure_kpa = pressure_kpa
        self._lags_s = lags_s
        self._surroundings = surroundings
        self._clip_kpa = emulation.clip_kpa or math.inf
        self._over_range = over_range if over_range is not None else FaultTiming()
        self._puncture = puncture
        self._epoch_ns: int | None = None

    def begin_scene_time(self, epoch_ns: int) -> None:
        """Begin the scene's time at this instant of the clock."""
        self._epoch_ns = epoch_ns

    def to_scene_s(self, t_ns: int) -> float:
        """Convert an instant of the clock to the scene's time."""
        # A conversion begun before the scene samples its first instant.
        return 0.0 if self._epoch_ns is None else max(0.0, (t_ns - self._epoch_ns) * 1e-9)

    def compute_kpa(self, t_s: float, t_ns: int) -> float:
        """Compute the pressure on the chip at a time of the scene and the same of the clock."""
        kpa = self._pressure_kpa(t_s)
        if self._puncture is not None:
            kpa = self._puncture.apply_leak(kpa, t_s, t_ns)
        kpa = min(kpa, self._clip_kpa)
        return kpa + _FAR_OVER_RANGE_KPA if self._over_range(t_ns) else kpa

    def compute_degc(self, t_s: float) -> float:
        """Compute the chip's temperature at a time of the scene."""
        return self._surroundings.compute_chip_degc(t_s, *self._lags_s)
