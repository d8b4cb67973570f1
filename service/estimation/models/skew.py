"""`skew`: tiles are sampled one after another; a frame is about one instant.

Every tile's value at the frame's `t_ns`, on the straight line between the previous sample and its
own. Not needed with `denoise`, whose windows are evaluated at that instant.
"""

from __future__ import annotations

import math

import numpy as np

from devices.jit import jit_cached
from service.estimation.records import KernelRecord


class SkewState(KernelRecord):
    """Previous sample of a tile."""

    value: float = np.nan  # NaN before the first
    t_ns: int


@jit_cached
def interpolate_to_frame(
    state: SkewState, value: float, t_ns: int, frame_t_ns: int, after_gap: bool
) -> float:
    """Interpolate a tile's value to the frame's instant.

    Args:
        state: sample of the previous frame; updated.
        value: NaN if there is none.
        t_ns: instant of the sample.
        frame_t_ns: instant of the frame.
        after_gap: whether the frame is the first after a gap, across which no line is drawn.
    """
    before, step_ns = state.value, float(t_ns - state.t_ns)
    state.value, state.t_ns = value, t_ns
    if after_gap or step_ns <= 0.0 or not math.isfinite(before):
        return value
    back = (t_ns - frame_t_ns) / step_ns
    return value - back * (value - before) if 0.0 <= back <= 1.0 else value
