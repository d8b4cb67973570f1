"""`ambient`: weather and water around the domes, measured by bare reference tiles.

A dome's wall passes on a part of a pressure around it, c p/(1 + c p) with the wall's give c
(hardware.md 9: a tenth). A bare chip reads all of it; its noise is averaged over 30 ms, because it
would stand in the forces of all tiles at once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from devices.arrays import Floats
from devices.compiled import compiled
from service.estimation.records import Record, Records, record_type, records

SMOOTHING_S = 0.03  # long against noise, short against a foot that sinks in
HELD_S = 0.2
"""A foot sinks or is lifted in this time: older readings do not tell its depth."""


LAW = record_type([("passed", np.float64), ("relative_sigma", np.float64)])
"""Constants of a tile, as in `Ambient`."""
STATE = record_type([("head_kpa", np.float64), ("t_ns", np.int64)])
"""Averaged pressure around the foot above the tare's, and when; NaN before the first."""


def at_rest() -> Records:
    """Before the first reading."""
    return records(STATE, 1, head_kpa=np.nan)


@dataclass(frozen=True)
class Ambient:
    """Parameters over bearing tiles.

    Attributes:
        passed: part of a pressure around the dome that reaches its gas.
        relative_sigma: its standard uncertainty, relative.
    """

    passed: Floats
    relative_sigma: float

    def laws(self) -> Records:
        """The constants, tile by tile."""
        return records(LAW, len(self.passed), **vars(self))


@compiled
def around(state: Record, kpa: float, t_ns: int) -> float:
    """Averaged pressure around the foot above the tare's; NaN where it is not known.

    Args:
        state: from the frames before; becomes that after this one.
        kpa: mean of the bare tiles above their tare; NaN if none could be read, and then the last
            one holds for `HELD_S`.
        t_ns: instant.
    """
    if math.isfinite(kpa):
        if math.isnan(state.head_kpa):
            state.head_kpa = kpa
        else:
            passed_s = max(0.0, (t_ns - state.t_ns) * 1e-9)
            state.head_kpa -= math.expm1(-passed_s / SMOOTHING_S) * (kpa - state.head_kpa)
        state.t_ns = t_ns
    head_kpa: float = state.head_kpa
    return head_kpa if t_ns - state.t_ns <= HELD_S * 1e9 else math.nan
