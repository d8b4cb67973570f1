"""Warmth that no model corrects: how far it has moved the baseline, as far as the chip tells.

Without the model `temperature` all of it is error, and all tiles err to the same side. The gas
follows its chip within seconds, so what counts is the more of what the chip is, and has been.
"""

from __future__ import annotations

import math

import numpy as np

from devices.compiled import compiled
from devices.frames import NOT_READ
from service.estimation.records import Record, Records, record_type, records

SMOOTH_S = 0.5  # long against the noise of half a count
LAG_S = 5.0  # of the gas behind its chip, at most

STATE = record_type([("chip", np.float64), ("gas", np.float64), ("t_ns", np.int64)])
"""What is remembered of each tile: counts from the tare's, NaN before the first."""


def at_rest(tiles: int) -> Records:
    """Before the first reading."""
    return records(STATE, tiles, chip=np.nan, gas=np.nan)


@compiled
def moved_kpa(
    tile: Record, tadc: int, tare_counts: float, kpa_per_count: float, t_ns: int
) -> float:
    """What warmth since the tare has moved the baseline by, signed; 0 where it is not known.

    Args:
        tile: state from its readings before; becomes that after this one.
        tadc: `NOT_READ` where unknown.
        tare_counts: at the tare, NaN where not known.
        kpa_per_count: of the baseline.
        t_ns: instant.
    """
    now = tadc - tare_counts
    if tadc != NOT_READ and not math.isnan(now):
        if math.isnan(tile.chip):
            tile.chip = tile.gas = now
        else:
            step_s = max(0.0, (t_ns - tile.t_ns) * 1e-9)
            tile.chip += step_s / (SMOOTH_S + step_s) * (now - tile.chip)
            tile.gas += step_s / (LAG_S + step_s) * (tile.chip - tile.gas)
        tile.t_ns = t_ns
    more = tile.chip if abs(tile.chip) > abs(tile.gas) else tile.gas
    return 0.0 if math.isnan(more) else kpa_per_count * more
