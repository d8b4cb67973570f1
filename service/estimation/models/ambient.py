"""`ambient`: weather and water around the domes, measured by bare reference tiles.

A dome's wall transmits a part of the surrounding pressure, c p/(1 + c p) with the wall's compliance
c (hardware.md 9: a tenth). A bare chip reads the whole pressure. Its noise is averaged over 30 ms,
because it would enter the forces of all tiles at once.
"""

from __future__ import annotations

import math
from typing import Self

import numpy as np

from devices.errors import UsageError
from devices.jit import jit_cached
from service.estimation.models import LoadBearingTiles, ModelParams
from service.estimation.records import KernelRecord, RecordArray

SMOOTHING_S = 0.03  # long against noise, short against a foot that sinks in
HELD_S = 0.2
"""Time for which the last reading holds: a foot sinks or is lifted within it."""


class AmbientParams(ModelParams):
    """Parameters of a tile."""

    effect = "temperature"
    is_needed_of_every_tile = True

    transmitted_fraction: float  # part of the surrounding pressure that reaches the dome's gas
    relative_sigma: float  # its standard uncertainty, relative

    @classmethod
    def make(cls, tiles: LoadBearingTiles) -> RecordArray[Self]:
        """Make the parameters of load-bearing tiles, (tiles,).

        Raises:
            UsageError: the array has no bare tile.
        """
        if not tiles.has_bare_tile:
            raise UsageError(
                "model 'ambient' needs a bare reference tile, and the array has none",
                remedy="Leave it out, or plug in a bare chip and mark it `reference = true`",
            )
        give = tiles.wall_per_kpa * tiles.baseline_kpa
        found = [e for tile in tiles.calibrations if (e := tile.effects.temperature) is not None]
        wall = [e.wall_per_kpa for e in found]
        relative = max((w.sigma / w.value if w.value > 0.0 else 1.0 for w in wall), default=1.0)
        return cls.array(
            len(give), transmitted_fraction=give / (1.0 + give), relative_sigma=relative
        )


class AmbientState(KernelRecord):
    """Surrounding pressure of the foot."""

    pressure_kpa: float = np.nan  # low-pass, above the tare's; NaN before the first reading
    t_ns: int  # instant of the last reading


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
