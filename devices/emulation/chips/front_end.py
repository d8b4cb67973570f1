"""Analogue front end of an MPL115A2: from gas pressure to the two words of a conversion.

Noise as in a real part (hardware.md 1.3): 0.165 kPa in all, rounding included, with 1.2 % of
readings more than 0.5 kPa off, mostly low. Counts past either end wrap, as in real parts.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np

from devices.chips.mpl115a2 import PRESSURE_MAX_KPA, PRESSURE_MIN_KPA
from devices.emulation.fault_timing import FaultTiming
from devices.emulation.parts import ChipProperties, DomeProperties, make_rng
from devices.emulation.puncture import Puncture
from devices.emulation.surroundings import Surroundings
from devices.scene.emulation_sections import EmulationSection

_KPA_PER_PCOMP = (PRESSURE_MAX_KPA - PRESSURE_MIN_KPA) / 1023
_TADC_PER_KELVIN = -5.35
_TADC_NOISE = 0.5  # in counts

_MEASURED_NOISE_KPA = 0.165
_OUTLIER_RATE = 0.012
_OUTLIER_KPA = (0.5, 1.2)  # range of their size, at the measured noise
_OUTLIERS_LOW = 0.85  # most are low (hardware.md 1.3)
_DRAWN_AT_ONCE = 1024  # a call of numpy for each reading would be slow
_FAR_OVER_RANGE_KPA = 45.0


class FrontEnd:
    """Sampler of one dome, or of the surroundings of a bare chip: called by the emulated chip.

    Before `begin` the dome is at the scene's first instant. Fault `over_range`: pressure is 45 kPa
    higher, past the range; most parts wrap. `frozen`: the pressure word stays constant, the
    temperature word does not.
    """

    def __init__(
        self,
        chip: ChipProperties,
        dome: DomeProperties,
        pressure_kpa: Callable[[float], float],
        surroundings: Surroundings,
        scene: EmulationSection,
        label: str,
        over_range: FaultTiming | None = None,
        frozen: FaultTiming | None = None,
        puncture: Puncture | None = None,
    ) -> None:
        self._c = chip.coefficients
        self._tadc_at_25 = chip.tadc_at_25_degc
        self._lags_s = dome.chip_lag_s, dome.gas_lag_s
        self._pressure_kpa = pressure_kpa
        self._surroundings = surroundings
        self._clip_kpa = scene.clip_kpa or math.inf
        self._epoch_ns: int | None = None
        self._over_range = over_range if over_range is not None else FaultTiming()
        self._frozen = frozen if frozen is not None else FaultTiming()
        self._puncture = puncture
        self._padc = -1  # none so far
        self._noise = _generate_noise(scene, self._lsb_kpa(), make_rng(label))
        self._correlated_s = scene.correlated_ms * 1e-3
        self._core_kpa = 0.0
        self._last_s = -math.inf
        self._is_temperature_constant = surroundings.is_temperature_constant
        self._constant_tadc = self._true_tadc(0.0)

    def begin_scene_time(self, epoch_ns: int) -> None:
        """Begin the scene's time at this instant of the clock."""
        self._epoch_ns = epoch_ns

    def __call__(self, t_ns: int) -> tuple[int, int]:
        """Compute the words `padc`, `tadc` of a conversion that samples at `t_ns`."""
        # A conversion begun before the scene samples its first instant.
        t_s = 0.0 if self._epoch_ns is None else max(0.0, (t_ns - self._epoch_ns) * 1e-9)
        core_kpa, outlier_kpa, tadc_noise = next(self._noise)
        kpa = self._pressure_kpa(t_s)
        if self._puncture is not None:
            kpa = self._puncture.apply_leak(kpa, t_s, t_ns)
        kpa = min(kpa, self._clip_kpa)
        if self._over_range(t_ns):
            kpa += _FAR_OVER_RANGE_KPA
        kpa += self._correlate(core_kpa, t_ns * 1e-9) + outlier_kpa
        # The true temperature affects the pressure word; the temperature word itself is noisy.
        tadc = self._constant_tadc if self._is_temperature_constant else self._true_tadc(t_s)
        c = self._c
        pcomp = (kpa - PRESSURE_MIN_KPA) / _KPA_PER_PCOMP
        padc = (pcomp - c.a0 - c.b2 * tadc) / (c.b1 + c.c12 * tadc)
        if self._padc < 0 or not self._frozen(t_ns):
            self._padc = round(padc) % 1024
        return self._padc, min(max(round(tadc + tadc_noise), 0), 1023)

    def _true_tadc(self, t_s: float) -> float:
        degc = self._surroundings.compute_chip_degc(t_s, *self._lags_s)
        return self._tadc_at_25 + (degc - 25.0) * _TADC_PER_KELVIN

    def _lsb_kpa(self) -> float:
        return abs(self._c.b1 + self._c.c12 * self._tadc_at_25) * _KPA_PER_PCOMP

    def _correlate(self, white_kpa: float, t_s: float) -> float:
        """Correlate the core noise in time (AR(1)), with unchanged variance."""
        if self._correlated_s == 0.0:
            return white_kpa
        keep = math.exp(-(t_s - self._last_s) / self._correlated_s)
        self._core_kpa = keep * self._core_kpa + math.sqrt(1.0 - keep * keep) * white_kpa
        self._last_s = t_s
        return self._core_kpa


def _generate_noise(
    scene: EmulationSection, lsb_kpa: float, rng: np.random.Generator
) -> Iterator[tuple[float, float, float]]:
    """Yield core noise and outlier in kPa, and temperature noise in counts, per conversion."""
    scale = scene.noise_kpa / _MEASURED_NOISE_KPA
    low, high = (scale * limit for limit in _OUTLIER_KPA)
    outlier_variance = _OUTLIER_RATE * (low * low + low * high + high * high) / 3
    core_variance = scene.noise_kpa**2 - outlier_variance - lsb_kpa**2 / 12
    core_kpa = math.sqrt(max(0.0, core_variance))
    n = _DRAWN_AT_ONCE
    while True:
        core = core_kpa * rng.standard_normal(n)
        size = rng.uniform(low, high, n) * np.where(rng.random(n) < _OUTLIERS_LOW, -1.0, 1.0)
        outlier = np.where(rng.random(n) < _OUTLIER_RATE, size, 0.0)
        temperature = _TADC_NOISE * rng.standard_normal(n)
        yield from zip(core.tolist(), outlier.tolist(), temperature.tolist(), strict=True)
