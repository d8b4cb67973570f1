"""Clock of an instrument that is started by hand, with an unknown start and a drift."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from devices.arrays import Floats


@dataclass(frozen=True)
class PlateClock:
    """Sample clock of an instrument.

    Attributes:
        rate_hz: nominal sample rate.
        start_s: instant of the first sample, in seconds of the scene.
        drift_ppm: excess of the real rate.
    """

    rate_hz: float
    start_s: float
    drift_ppm: float

    def compute_sample_times(self, end_s: float) -> tuple[Floats, Floats]:
        """Compute the sample times until the scene's `end_s`.

        Returns:
            Times by the instrument, from zero, and by the scene, from `start_s`, both (n,); empty
            if `end_s` is before the start.
        """
        goes = 1.0 + 1e-6 * self.drift_ppm
        n = max(0, int((end_s - self.start_s) * goes * self.rate_hz))
        time_s = np.arange(n) / self.rate_hz
        return time_s, self.start_s + time_s / goes
