"""Whole-foot force over consecutive frames of one stream."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from devices.frames import FrameBatch


class ForceSpan(NamedTuple):
    """GRF over consecutive frames; forces are NaN where unknown."""

    seq_first: int
    seq: int
    n: int
    """Number of frames; less than the range of numbers where some are missing."""
    t_ns_first: int
    t_ns: int
    """Time of the newest frame, node's UTC."""
    grf_n: float
    """GRF of the newest frame."""
    grf_min_n: float
    grf_max_n: float
    grf_lower_bound_max_n: float
    """Greatest lower bound among the frames without a GRF."""

    def join(self, later: ForceSpan) -> ForceSpan:
        """Return this span and a later one as one."""
        return ForceSpan(
            self.seq_first,
            later.seq,
            self.n + later.n,
            self.t_ns_first,
            later.t_ns,
            later.grf_n,
            nan_min(self.grf_min_n, later.grf_min_n),
            nan_max(self.grf_max_n, later.grf_max_n),
            nan_max(self.grf_lower_bound_max_n, later.grf_lower_bound_max_n),
        )


def summarize_force(frames: FrameBatch, columns: Mapping[str, npt.NDArray[Any]]) -> ForceSpan:
    """Return frames and their estimates, which may be none, as a span."""
    grf_n = columns.get("grf_n", _NO_VALUE)
    is_unknown = np.isnan(grf_n)
    bounds_n = columns.get("grf_lower_bound_n", _NO_VALUE)
    hidden_n = (
        bounds_n[is_unknown] if len(bounds_n) == len(grf_n) and is_unknown.any() else _NO_VALUE
    )
    return ForceSpan(
        seq_first=int(frames.seq[0]),
        seq=int(frames.seq[-1]),
        n=len(frames),
        t_ns_first=int(frames.t_ns[0]),
        t_ns=int(frames.t_ns[-1]),
        grf_n=float(grf_n[-1]),
        grf_min_n=float(np.fmin.reduce(grf_n)),
        grf_max_n=float(np.fmax.reduce(grf_n)),
        grf_lower_bound_max_n=float(np.fmax.reduce(hidden_n)),
    )


_NO_VALUE = np.full(1, math.nan)


def nan_min(a: float, b: float) -> float:
    """Return the smaller of two numbers; NaN counts as missing."""
    return b if math.isnan(a) else a if math.isnan(b) else min(a, b)


def nan_max(a: float, b: float) -> float:
    """Return the greater of two numbers; NaN counts as missing."""
    return -nan_min(-a, -b)
