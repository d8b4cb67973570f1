"""Warmth that no model corrects: how far it has moved the baseline, as far as the chip tells.

Without the model `temperature` all of it is error, and all tiles err to the same side. The gas
follows its chip within seconds, so what counts is the more of what the chip is, and has been.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from devices.arrays import Floats, Ints, Times
from devices.compiled import compiled
from devices.frames import NOT_READ
from service.estimation.watch.state import State, copied

SMOOTH_S = 0.5  # long against the noise of half a count
LAG_S = 5.0  # of the gas behind its chip, at most

STATE = np.dtype([("chip", np.float64), ("gas", np.float64), ("t_ns", np.int64)])
"""What is remembered of each tile: counts from the tare's, NaN before the first."""


def at_rest(tiles: int) -> State:
    """Before the first reading."""
    state = np.zeros(tiles, dtype=STATE)
    state["chip"] = state["gas"] = np.nan
    return state


def moved_kpa(
    tadc: npt.NDArray[np.uint16],
    tare_counts: Floats,
    kpa_per_count: Floats,
    t_ns: Times,
    state: State,
) -> tuple[Floats, State]:
    """What warmth since the tare has moved baselines by, signed; 0 where it is not known.

    Args:
        tadc: (n, tiles), `NOT_READ` where unknown.
        tare_counts: (tiles,), at the tare, NaN where not known.
        kpa_per_count: (tiles,), of the baseline.
        t_ns: (n, tiles), instants.
        state: from the readings before.
    """
    after = copied(state)
    kpa = np.empty(tadc.shape)
    _follow(
        tadc.astype(np.int64, order="C"),
        tare_counts,
        kpa_per_count,
        np.ascontiguousarray(t_ns),
        after,
        kpa,
    )
    return kpa, after


@compiled
def _follow(
    tadc: Ints,
    tare_counts: Floats,
    kpa_per_count: Floats,
    t_ns: Times,
    state: State,
    kpa: Floats,
) -> None:
    n, tiles = tadc.shape
    for j in range(tiles):
        tile = state[j]
        for i in range(n):
            now = tadc[i, j] - tare_counts[j]
            if tadc[i, j] != NOT_READ and not math.isnan(now):
                if math.isnan(tile.chip):
                    tile.chip = tile.gas = now
                else:
                    step_s = max(0.0, (t_ns[i, j] - tile.t_ns) * 1e-9)
                    tile.chip -= math.expm1(-step_s / SMOOTH_S) * (now - tile.chip)
                    tile.gas -= math.expm1(-step_s / LAG_S) * (tile.chip - tile.gas)
                tile.t_ns = t_ns[i, j]
            more = tile.chip if abs(tile.chip) > abs(tile.gas) else tile.gas
            kpa[i, j] = 0.0 if math.isnan(more) else kpa_per_count[j] * more
