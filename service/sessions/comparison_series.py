"""What a session was compared with at any zoom: bins with least and greatest, so no peak hides."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from devices.arrays import Ints, Times
from storage.formats.slice import Slice
from storage.schema import Array

GAP_STEPS = 3.5
"""Frames that are further apart than so many usual steps have something missing between them."""
_BINNED = ("reference_grf_n", "reference_cop_x_m", "reference_cop_y_m")


def bins_of_series(
    series: pa.Table, begin_ns: int, part: Slice, points: int
) -> tuple[dict[str, Array], int]:
    """Some time of a comparison.

    Args:
        series: of `storage.sessions.comparisons`.
        begin_ns: of the session's first frame.
        part: which time; its columns do not count.
        points: how many bins at the most, but for those that gaps break.

    Returns:
        `t_first_ns`, `t_last_ns`, `frames`, `missing` (1 if something is, just before the bin), and
        of the reference and of `error_n`, ours less that, `_min` and `_max`, NaN where neither is
        known; and how many frames a bin has at the most.
    """
    t_ns: Times = series["t_ns"].to_numpy()
    inside = np.flatnonzero(part.rows(t_ns, begin_ns))
    t_ns = t_ns[inside]
    values = {name: series[name].to_numpy()[inside].astype(np.float32) for name in _BINNED}
    values["error_n"] = series["grf_n"].to_numpy()[inside] - values["reference_grf_n"]
    size = max(1, -(-len(t_ns) // points))
    starts, gaps = _starts(t_ns, size)
    if not len(starts):
        empty = {name: np.empty(0, np.float32) for name in _names(values)}
        none = {name: np.empty(0, np.int64) for name in ("t_first_ns", "t_last_ns")}
        return none | {name: np.empty(0, np.uint32) for name in ("frames", "missing")} | empty, 1
    ends = np.append(starts[1:], len(t_ns))
    bins: dict[str, Array] = {
        "t_first_ns": t_ns[starts],
        "t_last_ns": t_ns[ends - 1],
        "frames": (ends - starts).astype(np.uint32),
        "missing": gaps.astype(np.uint32),
    }
    for name, column in values.items():
        bins[f"{name}_min"] = np.fmin.reduceat(column, starts)
        bins[f"{name}_max"] = np.fmax.reduceat(column, starts)
    return bins, size


def _names(values: dict[str, Array]) -> list[str]:
    return [f"{name}_{which}" for name in values for which in ("min", "max")]


def _starts(t_ns: Times, size: int) -> tuple[Ints, npt.NDArray[np.bool_]]:
    """First frame of every bin, and whether something is missing before it."""
    if not len(t_ns):
        return np.empty(0, np.int64), np.empty(0, np.bool_)
    steps = np.diff(t_ns)
    broken = np.flatnonzero(steps > GAP_STEPS * np.median(steps)) + 1 if len(steps) else steps
    edges = np.concatenate([[0], broken, [len(t_ns)]]).astype(np.int64)
    runs = [np.arange(first, end, size) for first, end in pairwise(edges)]
    starts = np.concatenate(runs)
    return starts, np.isin(starts, broken)
