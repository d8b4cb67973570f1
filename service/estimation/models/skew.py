"""`skew`: tiles are sampled one after another, and a frame is about one instant.

Every tile's value at the frame's `t_ns`, on the straight line between the sample before and its
own. With `denoise` there is no need of it: a window is evaluated at that instant right away.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from devices.arrays import Bools, Floats, Times


@dataclass(frozen=True)
class SkewState:
    """The last row: values and instants of all tiles."""

    values: Floats
    t_ns: Times


def at_rest(tiles: int) -> SkewState:
    """Before the first frame."""
    return SkewState(np.full(tiles, np.nan), np.zeros(tiles, dtype=np.int64))


def aligned(
    values: Floats,
    t_ns: Times,
    frame_t_ns: Times,
    broken: Bools,
    state: SkewState,
) -> tuple[Floats, SkewState]:
    """Values at the frames' instants.

    Args:
        values: (n, tiles), NaN where there is none.
        t_ns: (n, tiles), when they were sampled.
        frame_t_ns: (n,), the frames' instants.
        broken: (n,), frames after a gap: there is no line across it.
        state: from the frames before.
    """
    before = np.concatenate([state.values[None], values[:-1]])
    before_ns = np.concatenate([state.t_ns[None], t_ns[:-1]])
    step_ns = (t_ns - before_ns).astype(np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        back = (t_ns - frame_t_ns[:, None]) / step_ns
        usable = (step_ns > 0.0) & (back >= 0.0) & (back <= 1.0) & ~broken[:, None]
        line = values - back * (values - before)
    out = np.where(usable & np.isfinite(before), line, values)
    return out, SkewState(values[-1], t_ns[-1])
