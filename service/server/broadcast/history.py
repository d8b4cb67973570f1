"""History of a node's GRF over the last minute, for a page that is opened now.

Spans with minimum and maximum, so that no peak hides. The newest ones are kept as they were
published, so that live messages continue them without a seam; older ones are merged. Memory is
bounded: 130 kB, and 50 kB for the newest.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from devices.frames import FrameBatch
from storage.intervals import NO_END


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


SECONDS_MAX = 60.0
FORCE_SPAN_PERIOD_NS = 1_000_000_000 // 30
"""Least distance between the begins of merged spans: no plot of a minute is finer."""
_AS_PUBLISHED_NS = 2_000_000_000
_AS_PUBLISHED_MAX = 128
_MERGED_MAX = int(SECONDS_MAX * 1e9) // FORCE_SPAN_PERIOD_NS + 2
_ROW = np.dtype(
    [
        *((name, np.int64) for name in ("seq_first", "seq", "n", "t_ns_first", "t_ns")),
        *((name, float) for name in ForceSpan._fields if name.startswith("grf_")),
    ]
)


def select_newest_spans(
    rows: npt.NDArray[np.void], seconds: float, before_seq: int | None
) -> npt.NDArray[np.bool_]:
    """Return a mask of the spans that begin before a number, and lie in the seconds before it."""
    keep = np.asarray(rows["seq_first"] < (NO_END if before_seq is None else before_seq))
    if keep.any():
        keep &= rows["t_ns"] > rows["t_ns"][keep][-1] - int(seconds * 1e9)
    return keep


class ForceHistory:
    """GRF over the last minute of a stream.

    Args:
        stream_id: stream of the frames.
    """

    def __init__(self, stream_id: str) -> None:
        self.stream_id = stream_id
        self._as_published: deque[ForceSpan] = deque()
        self._last_merged: ForceSpan | None = None
        """Newest merged span, to which more may be added."""
        self._merged = np.zeros(_MERGED_MAX, _ROW)
        self._count = 0
        """Number of spans ever written to the ring `_merged`."""

    def add_span(self, span: ForceSpan) -> None:
        """Add frames that are published now, newer than those before."""
        self._as_published.append(span)
        while (
            span.t_ns - self._as_published[0].t_ns > _AS_PUBLISHED_NS
            or len(self._as_published) > _AS_PUBLISHED_MAX
        ):
            self._merge(self._as_published.popleft())

    def get_newest_spans(
        self, seconds: float, before_seq: int | None = None
    ) -> npt.NDArray[np.void]:
        """Return the newest seconds, with the fields of `ForceSpan`, oldest first.

        Args:
            seconds: counted back from the newest frame.
            before_seq: only spans that begin before this number.
        """
        first = max(0, self._count - _MERGED_MAX)
        older = self._merged[np.arange(first, self._count) % _MERGED_MAX]
        newer = [*([] if self._last_merged is None else [self._last_merged]), *self._as_published]
        rows = np.concatenate([older, np.array(newer, _ROW)])
        return rows[select_newest_spans(rows, seconds, before_seq)]

    def _merge(self, span: ForceSpan) -> None:
        before = self._last_merged
        if before is not None:
            if span.t_ns_first - before.t_ns_first < FORCE_SPAN_PERIOD_NS:
                self._last_merged = before.join(span)
                return
            self._merged[self._count % _MERGED_MAX] = before
            self._count += 1
        self._last_merged = span
