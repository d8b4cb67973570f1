"""What every ground is: forces on the domes as a function of time.

Forces are along each dome's axis, times in seconds since power-up. They are the ground truth of a
scene.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

import numpy as np

from devices.arrays import Floats


class Ground(ABC):
    """A load on all domes of a foot; by default it never ends and the foot does not turn."""

    arc_rad: Floats | None = None
    """Angle of each dome's axis in the foot; None: all are upright, whatever the segment does."""

    @property
    def duration_s(self) -> float | None:
        """When its programme is over; None for one that goes on."""
        return None

    @abstractmethod
    def forces_n(self, t_s: Floats) -> Floats:
        """Force on each dome along its axis, (len(t_s), tiles)."""

    def rest_n(self, t_s: Floats) -> Floats:
        """Vertical force on the foot that no dome bears."""
        return np.zeros(len(t_s))

    def angle_rad(self, t_s: Floats) -> Floats | None:
        """Angle of the foot segment; None for a foot without a moving segment."""
        return None

    def tilt_rad(self, t_s: Floats) -> Floats:
        """Angle of each dome's axis ahead of the vertical, (n, tiles); (n, 1) if all stand."""
        angle_rad = self.angle_rad(t_s)
        if self.arc_rad is None or angle_rad is None:
            return np.zeros((len(t_s), 1))
        return np.asarray(self.arc_rad - angle_rad[:, None])


def in_round(t_s: Floats, lead_s: float, round_s: float) -> Floats:
    """Times within the first of many rounds of `round_s` after the lead; infinite: there is one."""
    t_s = np.asarray(t_s)
    if not math.isfinite(round_s):
        return t_s
    since_s = t_s - lead_s
    return np.where(since_s < 0.0, t_s, np.mod(since_s, round_s) + lead_s)
