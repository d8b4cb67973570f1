"""Base class of grounds: forces on the domes as a function of time, the ground truth of a scene.

Forces are along each dome's axis, times in seconds since power-up.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

import numpy as np

from devices.arrays import Floats


class Ground(ABC):
    """Load on all domes of a foot; by default endless, and with a fixed segment."""

    arc_rad: Floats | None = None
    """Angle of each dome's axis in the foot; None: all stay upright at any segment angle."""

    @property
    def duration_s(self) -> float | None:
        """End of the load; None for an endless one."""
        return None

    @abstractmethod
    def forces_n(self, t_s: Floats) -> Floats:
        """Compute the force on each dome along its axis, (len(t_s), tiles)."""

    def force_beside_domes_n(self, t_s: Floats) -> Floats:
        """Compute the vertical force on the foot beside the domes."""
        return np.zeros(len(t_s))

    def angle_rad(self, t_s: Floats) -> Floats | None:
        """Compute the angle of the foot segment; None for a foot without a moving segment."""
        return None

    def tilt_rad(self, t_s: Floats) -> Floats:
        """Compute the angle of each dome's axis ahead of the vertical, (n, tiles) or (n, 1)."""
        angle_rad = self.angle_rad(t_s)
        if self.arc_rad is None or angle_rad is None:
            return np.zeros((len(t_s), 1))
        return np.asarray(self.arc_rad - angle_rad[:, None])


def map_to_first_round(t_s: Floats, lead_s: float, round_s: float) -> Floats:
    """Map times to the first round after the lead; `round_s` infinite: a single round."""
    t_s = np.asarray(t_s)
    if not math.isfinite(round_s):
        return t_s
    since_s = t_s - lead_s
    return np.where(since_s < 0.0, t_s, np.mod(since_s, round_s) + lead_s)
