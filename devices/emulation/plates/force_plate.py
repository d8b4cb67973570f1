"""Emulated small force plate with six channels and realistic errors.

The plate is a mass on a spring; its amplifier has a low-pass filter. Channels have crosstalk, gain
errors, a drifting offset, noise, and quantization. Sources and confidence of the numbers are in
hardware.md 11.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from devices.arrays import Floats
from devices.emulation.plates.plate import FORCES, MOMENTS, VERTICAL, PlateClock

CHANNELS = ("fx_n", "fy_n", "fz_n", "mx_nm", "my_nm", "mz_nm")
RATE_HZ = 1000.0
RANGE = np.array([125.0, 125.0, 250.0, 12.0, 12.0, 6.0])
"""Range of the channels, either way, in N and N m."""
BITS = 16
NATURAL_HZ, DAMPING = 400.0, 0.05
FILTER_HZ = 300.0
"""Corner frequency of the low-pass filter: Butterworth, second order."""
GAIN = 0.005
"""Largest gain error of a channel, relative."""
CROSSTALK, CROSSTALK_OF_VERTICAL = 0.02, 0.005
"""Largest crosstalk from a force to another, or from a moment to another; from the vertical force.
"""
LEVER_M = 0.0005
"""Largest moment shown per newton."""
WHITE, SLOW = 4e-4, 2e-4
"""Standard deviations of the noise, in parts of the range."""
SLOW_S = 3.0
OFFSET = 4e-3
"""Largest offset after zeroing by hand, in parts of the range."""
CREEP_PER_S = 4e-5
"""Largest drift of that offset, in parts of the range per second."""
STATED_SIGMA_N = 0.25
"""Standard uncertainty of a vertical force of some 20 N after subtraction of the zero, as a user
would combine it: noise, a uniform gain within half a per cent, crosstalk of 2 N."""
DRIFT_PPM = 50.0
LATEST_S = 0.4

Complexes = npt.NDArray[np.complex128]

_FINER = 4  # oversampling of the filters
_PAD_S = 0.1  # lead-in for the filters' transients


@dataclass(frozen=True)
class ForcePlate:
    """Force plate in one trial.

    Attributes:
        clock: clock of the plate.
        sensitivity: (6, 6), sensitivity of each channel to each load.
        offset: (6,), offset at the first sample.
        creep_per_s: (6,), drift of the offset.
    """

    clock: PlateClock
    sensitivity: Floats
    offset: Floats
    creep_per_s: Floats

    @classmethod
    def draw(cls, plate: np.random.Generator, trial: np.random.Generator) -> ForcePlate:
        """Draw a plate's properties and the set-up of a trial, each by its own generator."""
        mixing = np.eye(6) * (1.0 + GAIN * plate.uniform(-1.0, 1.0, 6))
        part = CROSSTALK * plate.uniform(-1.0, 1.0, (6, 6))
        part[:, VERTICAL] *= CROSSTALK_OF_VERTICAL / CROSSTALK
        for kind in (FORCES, MOMENTS):
            own = np.ix_(kind, kind)
            mixing[own] += part[own] * (1.0 - np.eye(3))
        mixing[np.ix_(MOMENTS, FORCES)] += LEVER_M * plate.uniform(-1.0, 1.0, (3, 3))
        return cls(
            clock=PlateClock(
                RATE_HZ,
                start_s=trial.uniform(0.05, LATEST_S),
                drift_ppm=plate.uniform(-DRIFT_PPM, DRIFT_PPM),
            ),
            sensitivity=mixing,
            offset=RANGE * OFFSET * trial.uniform(-1.0, 1.0, 6),
            creep_per_s=RANGE * CREEP_PER_S * trial.uniform(-1.0, 1.0, 6),
        )

    @property
    def delay_s(self) -> float:
        """Delay of slow loads: the spring's and the filter's."""
        return DAMPING / (math.pi * NATURAL_HZ) + math.sqrt(0.5) / (math.pi * FILTER_HZ)

    def simulate_recording(
        self, wrench: Callable[[Floats], Floats], end_s: float, noise: np.random.Generator
    ) -> tuple[Floats, Floats]:
        """Simulate a recording of a load until `end_s` of the scene.

        Args:
            wrench: forces and moments at instants of the scene, (n, 6).
            end_s: end of the recording.
            noise: random generator of the noise.

        Returns:
            Times by the plate's clock (n,), and its channels (n, 6).
        """
        time_s, t_s = self.clock.compute_sample_times(end_s)
        shown = self._filter_load(wrench, t_s) @ self.sensitivity.T
        shown += self.offset + time_s[:, None] * self.creep_per_s
        shown += RANGE * WHITE * noise.standard_normal(shown.shape)
        shown += RANGE * SLOW * self._draw_slow_noise(len(time_s), noise)
        step = RANGE / 2 ** (BITS - 1)
        return time_s, np.asarray(np.clip(np.rint(shown / step) * step, -RANGE, RANGE - step))

    def _filter_load(self, wrench: Callable[[Floats], Floats], t_s: Floats) -> Floats:
        """Apply spring and filter to the load, exactly, as both are linear."""
        if not len(t_s):
            return np.zeros((0, 6))
        step_s = 1.0 / (_FINER * self.clock.rate_hz * (1.0 + 1e-6 * self.clock.drift_ppm))
        before = math.ceil(_PAD_S / step_s)
        fine_s = t_s[0] + step_s * np.arange(-before, _FINER * len(t_s))
        load = wrench(np.maximum(fine_s, 0.0))
        i_hz: Complexes = np.asarray(1j * np.fft.rfftfreq(len(fine_s), step_s), np.complex128)
        passed = 1.0 / _second_order(i_hz / NATURAL_HZ, DAMPING)
        passed /= _second_order(i_hz / FILTER_HZ, math.sqrt(0.5))
        spectrum = np.fft.rfft(load, axis=0) * passed[:, None]
        return np.asarray(np.fft.irfft(spectrum, len(fine_s), axis=0)[before::_FINER])

    def _draw_slow_noise(self, n: int, noise: np.random.Generator) -> Floats:
        """Draw noise of unit variance with correlation time `SLOW_S`, linear between knots."""
        decay = math.exp(-0.1)
        knot_s = 0.1 * SLOW_S
        knots = noise.standard_normal((2 + int(n / (self.clock.rate_hz * knot_s)), 6))
        for i in range(1, len(knots)):
            knots[i] = decay * knots[i - 1] + math.sqrt(1.0 - decay**2) * knots[i]
        at = np.arange(n) / (self.clock.rate_hz * knot_s)
        known = np.arange(len(knots))
        return np.stack([np.interp(at, known, column) for column in knots.T], axis=1)


def _second_order(i: Complexes, damping: float) -> Complexes:
    return np.asarray(i**2 + 2.0 * damping * i + 1.0)
