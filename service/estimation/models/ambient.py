"""`ambient`: weather and water around the domes, measured by bare reference tiles.

A dome's wall passes on a part of a pressure around it, c p/(1 + c p) with the wall's give c
(hardware.md 9: a tenth). A bare chip reads all of it; its noise is averaged over 30 ms, because it
would stand in the forces of all tiles at once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from devices.arrays import Floats, Times
from devices.compiled import compiled

SMOOTHING_S = 0.03  # long against noise, short against a foot that sinks in
HELD_S = 0.2
"""A foot sinks or is lifted in this time: older readings do not tell its depth."""


@dataclass(frozen=True)
class AmbientState:
    """Averaged pressure around the foot above the tare's, and when; NaN before the first."""

    head_kpa: float
    t_ns: int


AT_REST = AmbientState(math.nan, 0)
"""Before the first reading."""


@dataclass(frozen=True)
class Ambient:
    """Parameters over bearing tiles.

    Attributes:
        passed: part of a pressure around the dome that reaches its gas.
        relative_sigma: its standard uncertainty, relative.
    """

    passed: Floats
    relative_sigma: float

    def passed_on(
        self, reference_gauge_kpa: Floats, t_ns: Times, state: AmbientState
    ) -> tuple[Floats, Floats, AmbientState]:
        """Pressure in each dome that comes from around it.

        Args:
            reference_gauge_kpa: (n,), mean of the bare tiles above their tare; NaN where none
                could be read, and then the last one holds for `HELD_S`.
            t_ns: (n,) instants.
            state: from the frames before.

        Returns:
            (n, tiles) pressures, their standard uncertainty, and the next state.
        """
        head_kpa = np.empty(len(reference_gauge_kpa))
        value, last_ns = _averaged(
            np.ascontiguousarray(reference_gauge_kpa), t_ns, state.head_kpa, state.t_ns, head_kpa
        )
        passed_kpa = head_kpa[:, None] * self.passed
        return passed_kpa, np.abs(self.relative_sigma * passed_kpa), AmbientState(value, last_ns)


@compiled
def _averaged(
    kpa: Floats,
    t_ns: Times,
    value: float,
    last_ns: int,
    out: Floats,
) -> tuple[float, int]:
    for i in range(len(kpa)):
        if math.isfinite(kpa[i]):
            if math.isnan(value):
                value = kpa[i]
            else:
                passed_s = max(0.0, (t_ns[i] - last_ns) * 1e-9)
                value -= math.expm1(-passed_s / SMOOTHING_S) * (kpa[i] - value)
            last_ns = t_ns[i]
        out[i] = value if t_ns[i] - last_ns <= HELD_S * 1e9 else math.nan
    return value, last_ns
