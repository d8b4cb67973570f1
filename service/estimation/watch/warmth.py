"""Warmth that no model corrects: how far it has moved the baseline, as far as the chip tells.

Without the model `temperature` all of it is error, and all tiles err to the same side. The gas
follows its chip within seconds, so what counts is the more of what the chip is, and has been.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from devices.arrays import Floats, Times
from service.estimation.compiled import compiled

SMOOTH_S = 0.5  # long against the noise of half a count
LAG_S = 5.0  # of the gas behind its chip, at most

STATE = np.dtype([("chip", np.float64), ("gas", np.float64), ("t_ns", np.int64)])
"""What is remembered of each tile: counts from the tare's, NaN before the first."""

State = npt.NDArray[np.void]


def at_rest(tiles: int) -> State:
    """Before the first reading."""
    state = np.zeros(tiles, dtype=STATE)
    state["chip"] = state["gas"] = np.nan
    return state


def moved(tadc: Floats, t_ns: Times, state: State) -> tuple[Floats, State]:
    """Counts that the temperature has moved by since the tare; 0 where not known.

    Args:
        tadc: (n, tiles), relative to the tare's; NaN where unknown.
        t_ns: (n, tiles), instants.
        state: from the readings before.
    """
    after = state.copy()
    counts = np.empty(tadc.shape)
    _follow(np.ascontiguousarray(tadc), np.ascontiguousarray(t_ns), after, counts)
    return counts, after


@compiled
def _follow(tadc: Floats, t_ns: Times, state: State, counts: Floats) -> None:
    n, tiles = tadc.shape
    for j in range(tiles):
        tile = state[j]
        for i in range(n):
            now = tadc[i, j]
            if not math.isnan(now):
                if math.isnan(tile.chip):
                    tile.chip = tile.gas = now
                else:
                    step_s = max(0.0, (t_ns[i, j] - tile.t_ns) * 1e-9)
                    tile.chip -= math.expm1(-step_s / SMOOTH_S) * (now - tile.chip)
                    tile.gas -= math.expm1(-step_s / LAG_S) * (tile.chip - tile.gas)
                tile.t_ns = t_ns[i, j]
            more = tile.chip if abs(tile.chip) > abs(tile.gas) else tile.gas
            counts[i, j] = 0.0 if math.isnan(more) else more
