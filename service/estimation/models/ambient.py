"""`ambient`: weather and water around the domes, measured by bare reference tiles.

A dome's wall transmits a part of the surrounding pressure, c p/(1 + c p) with the wall's compliance
c (hardware.md 9: a tenth). A bare chip reads the whole pressure. Its noise is averaged over 30 ms,
because it would enter the forces of all tiles at once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from devices.arrays import Floats
from devices.jit import jit_cached
from service.estimation.records import KernelRecord, RecordArray

SMOOTHING_S = 0.03  # long against noise, short against a foot that sinks in
HELD_S = 0.2
"""Time for which the last reading holds: a foot sinks or is lifted within it."""


class AmbientParams(KernelRecord):
    """Parameters of a tile, as in `AmbientModel`."""

    transmitted_fraction: float
    relative_sigma: float


class AmbientState(KernelRecord):
    """Surrounding pressure of the foot."""

    pressure_kpa: float  # low-pass, above the tare's; NaN before the first reading
    t_ns: int  # instant of the last reading


def initial_state() -> RecordArray[AmbientState]:
    """Make the state before the first reading."""
    return AmbientState.array(1, pressure_kpa=np.nan)


@dataclass(frozen=True)
class AmbientModel:
    """Parameters over load-bearing tiles.

    Attributes:
        transmitted_fraction: part of the surrounding pressure that reaches the dome's gas.
        relative_sigma: its standard uncertainty, relative.
    """

    transmitted_fraction: Floats
    relative_sigma: float

    def to_records(self) -> RecordArray[AmbientParams]:
        """Make the kernel's parameters, (tiles,)."""
        return AmbientParams.array(len(self.transmitted_fraction), **vars(self))


@jit_cached
def low_pass_ambient_kpa(state: AmbientState, above_tare_kpa: float, t_ns: int) -> float:
    """Update the low-pass; return the surrounding pressure above the tare's, NaN where unknown.

    Args:
        state: after the frames before; updated.
        above_tare_kpa: mean of the bare tiles above their tare. NaN if none was readable: the last
            value then holds for `HELD_S`.
        t_ns: instant.
    """
    if math.isfinite(above_tare_kpa):
        if math.isnan(state.pressure_kpa):
            state.pressure_kpa = above_tare_kpa
        else:
            passed_s = max(0.0, (t_ns - state.t_ns) * 1e-9)
            state.pressure_kpa -= math.expm1(-passed_s / SMOOTHING_S) * (
                above_tare_kpa - state.pressure_kpa
            )
        state.t_ns = t_ns
    return state.pressure_kpa if t_ns - state.t_ns <= HELD_S * 1e9 else math.nan
