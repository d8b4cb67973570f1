"""The clock of an instrument that is started by hand: it begins when it likes, and drifts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from devices.arrays import Floats


@dataclass(frozen=True)
class PlateClock:
    """Samples of an instrument.

    Attributes:
        rate_hz: as it states.
        start_s: when its first sample is, in seconds of the scene.
        drift_ppm: by how much it goes too fast.
    """

    rate_hz: float
    start_s: float
    drift_ppm: float

    def samples(self, end_s: float) -> tuple[Floats, Floats]:
        """Samples until the scene's `end_s`: their times by the instrument, and by the scene.

        Returns:
            Both (n,), from zero and from `start_s` on; empty if it ends before it starts.
        """
        goes = 1.0 + 1e-6 * self.drift_ppm
        n = max(0, int((end_s - self.start_s) * goes * self.rate_hz))
        time_s = np.arange(n) / self.rate_hz
        return time_s, self.start_s + time_s / goes
