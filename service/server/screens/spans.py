"""Whole-foot force over consecutive frames of one stream."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from devices.frames import FrameBatch


class Span(NamedTuple):
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
    grf_at_least_max_n: float
    """Greatest lower bound among the frames without a GRF."""

    def joined(self, later: Span) -> Span:
        """Return this span and a later one as one."""
        return Span(
            self.seq_first,
            later.seq,
            self.n + later.n,
            self.t_ns_first,
            later.t_ns,
            later.grf_n,
            min_of(self.grf_min_n, later.grf_min_n),
            max_of(self.grf_max_n, later.grf_max_n),
            max_of(self.grf_at_least_max_n, later.grf_at_least_max_n),
        )


def span_of(frames: FrameBatch, columns: Mapping[str, npt.NDArray[Any]]) -> Span:
    """Return frames and their estimates, which may be none, as a span."""
    grf_n = columns.get("grf_n", _UNKNOWN)
    is_unknown = np.isnan(grf_n)
    bounds_n = columns.get("grf_at_least_n", _UNKNOWN)
    hidden_n = (
        bounds_n[is_unknown] if len(bounds_n) == len(grf_n) and is_unknown.any() else _UNKNOWN
    )
    return Span(
        seq_first=int(frames.seq[0]),
        seq=int(frames.seq[-1]),
        n=len(frames),
        t_ns_first=int(frames.t_ns[0]),
        t_ns=int(frames.t_ns[-1]),
        grf_n=float(grf_n[-1]),
        grf_min_n=float(np.fmin.reduce(grf_n)),
        grf_max_n=float(np.fmax.reduce(grf_n)),
        grf_at_least_max_n=float(np.fmax.reduce(hidden_n)),
    )


_UNKNOWN = np.full(1, math.nan)


def min_of(a: float, b: float) -> float:
    """Return the smaller of two numbers; NaN counts as missing."""
    return b if math.isnan(a) else a if math.isnan(b) else min(a, b)


def max_of(a: float, b: float) -> float:
    """Return the greater of two numbers; NaN counts as missing."""
    return -min_of(-a, -b)
