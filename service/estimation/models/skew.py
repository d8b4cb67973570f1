"""`skew`: tiles are sampled one after another, and a frame is about one instant.

Every tile's value at the frame's `t_ns`, on the straight line between the sample before and its
own. With `denoise` there is no need of it: a window is evaluated at that instant right away.
"""

from __future__ import annotations

import math

import numpy as np

from devices.compiled import compiled
from service.estimation.records import Record, Records, record_type, records

STATE = record_type([("value", np.float64), ("t_ns", np.int64)])
"""Of a tile: the value before (NaN: none), and its instant."""


def at_rest(tiles: int) -> Records:
    """Before the first frame."""
    return records(STATE, tiles, value=np.nan)


@compiled
def at_frame(state: Record, value: float, t_ns: int, frame_t_ns: int, broken: bool) -> float:
    """Value at the frame's instant.

    Args:
        state: from the frame before; becomes that after this one.
        value: NaN if there is none.
        t_ns: when it was sampled.
        frame_t_ns: the frame's instant.
        broken: is it the first after a gap? There is no line across it.
    """
    before, step_ns = state.value, float(t_ns - state.t_ns)
    state.value, state.t_ns = value, t_ns
    if broken or step_ns <= 0.0 or not math.isfinite(before):
        return value
    back = (t_ns - frame_t_ns) / step_ns
    return value - back * (value - before) if 0.0 <= back <= 1.0 else value
