"""Spans of consecutive frames with minimum and maximum, and their last minute.

A batch is reduced once, for the live page and for both histories. No peak hides: spans are merged
by minimum and maximum, and NaN counts as missing.

The newest GRF spans are kept as published, so that live messages continue them without a seam;
older ones are merged. Spans of tiles are in half precision, to 0.05 % of the value, which no plot
shows. Memory of a stream is bounded: 200 kB, and 5 kB per tile.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from devices.arrays import Floats
from devices.frames import FrameBatch
from storage.intervals import NO_END

SECONDS_MAX = 60.0
FORCE_SPAN_PERIOD_NS = 1_000_000_000 // 30
"""Least distance between the begins of merged spans: no plot of a minute is finer."""
TILE_SPAN_PERIOD_NS = 100_000_000
TILE_QUANTITIES = ("force_n", "gauge_kpa")
_AS_PUBLISHED_NS = 2_000_000_000
_AS_PUBLISHED_MAX = 128
_HALF_MAX = float(np.finfo(np.float16).max)
_NO_VALUE = np.full(1, math.nan)


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


def nan_min(a: float, b: float) -> float:
    """Return the smaller of two numbers; NaN counts as missing."""
    return b if math.isnan(a) else a if math.isnan(b) else min(a, b)


def nan_max(a: float, b: float) -> float:
    """Return the greater of two numbers; NaN counts as missing."""
    return -nan_min(-a, -b)


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


def reduce_tiles(columns: Mapping[str, npt.NDArray[Any]], tile_count: int) -> Floats:
    """Return each tile's minimum and maximum of `TILE_QUANTITIES`, (2, quantities, tiles)."""
    found = np.full((2, len(TILE_QUANTITIES), tile_count), np.nan)
    for i, name in enumerate(TILE_QUANTITIES):
        if name in columns:
            np.fmin.reduce(columns[name], axis=0, out=found[0, i])
            np.fmax.reduce(columns[name], axis=0, out=found[1, i])
    return found


def join_tiles(earlier: npt.NDArray[Any], later: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return minima and maxima of `reduce_tiles` for both spans together."""
    found = np.empty_like(earlier)
    np.fmin(earlier[0], later[0], out=found[0])
    np.fmax(earlier[1], later[1], out=found[1])
    return found


class _SpanRing:
    """Ring of the last minute's spans, one for all frames within a period."""

    def __init__(self, row_fields: list[Any], period_ns: int) -> None:
        self.rows = np.zeros(int(SECONDS_MAX * 1e9) // period_ns + 2, np.dtype(row_fields))
        self._period_ns = period_ns
        self._count = 0
        """Number of spans ever begun."""
        self._newest_begin_ns = 0

    def find_or_begin_row(self, t_ns_first: int) -> tuple[int, bool]:
        """Return the index of the row of a span, and whether it begins with this span."""
        begins = not self._count or t_ns_first - self._newest_begin_ns >= self._period_ns
        if begins:
            self._newest_begin_ns = t_ns_first
            self._count += 1
        return (self._count - 1) % len(self.rows), begins

    def get_oldest_first(self) -> npt.NDArray[np.void]:
        """Return a copy of all rows."""
        return self.rows[
            np.arange(max(0, self._count - len(self.rows)), self._count) % len(self.rows)
        ]


class StreamHistory:
    """GRF and tiles over the last minute of a stream.

    Args:
        stream_id: stream of the frames.
        tile_count: number of tiles.
    """

    def __init__(self, stream_id: str, tile_count: int) -> None:
        self.stream_id, self.tile_count = stream_id, tile_count
        numbers = [(name, np.int64) for name in ForceSpan._fields if not name.startswith("grf_")]
        forces = [(name, float) for name in ForceSpan._fields if name.startswith("grf_")]
        self._as_published: deque[ForceSpan] = deque()
        self._forces = _SpanRing([*numbers, *forces], FORCE_SPAN_PERIOD_NS)
        self._tiles = _SpanRing(
            [
                *((name, np.int64) for name in ("seq_first", "seq", "n", "t_ns")),
                ("extremes", np.float16, (2, len(TILE_QUANTITIES), tile_count)),
            ],
            TILE_SPAN_PERIOD_NS,
        )

    def add_span(self, span: ForceSpan, tiles: Floats) -> None:
        """Add frames that are published now, newer than those before.

        Args:
            span: their GRF.
            tiles: their `reduce_tiles`.
        """
        self._as_published.append(span)
        while (
            span.t_ns - self._as_published[0].t_ns > _AS_PUBLISHED_NS
            or len(self._as_published) > _AS_PUBLISHED_MAX
        ):
            older = self._as_published.popleft()
            at, begins = self._forces.find_or_begin_row(older.t_ns_first)
            rows = self._forces.rows
            rows[at] = older if begins else ForceSpan(*rows[at].item()).join(older)
        at, begins = self._tiles.find_or_begin_row(span.t_ns_first)
        row, halves = self._tiles.rows[at], np.clip(tiles, -_HALF_MAX, _HALF_MAX).astype(np.float16)
        if begins:
            row["seq_first"], row["n"], row["extremes"] = span.seq_first, span.n, halves
        else:
            row["n"] += span.n
            row["extremes"] = join_tiles(row["extremes"], halves)
        row["seq"], row["t_ns"] = span.seq, span.t_ns

    def get_force_spans(
        self, seconds: float, before_seq: int | None = None
    ) -> npt.NDArray[np.void]:
        """Return the newest seconds of GRF, with the fields of `ForceSpan`, oldest first.

        Args:
            seconds: counted back from the newest selected span.
            before_seq: only spans that begin before this number.
        """
        newest = np.array(list(self._as_published), self._forces.rows.dtype)
        rows = np.concatenate([self._forces.get_oldest_first(), newest])
        return _select_newest(rows, seconds, before_seq)

    def get_tile_spans(self, seconds: float, before_seq: int | None = None) -> npt.NDArray[np.void]:
        """Return the newest seconds of tiles, as `get_force_spans`.

        Fields are `seq_first`, `seq`, `n` and `t_ns` as of `ForceSpan`, and `extremes` as of
        `reduce_tiles`.
        """
        return _select_newest(self._tiles.get_oldest_first(), seconds, before_seq)


def _select_newest(
    rows: npt.NDArray[np.void], seconds: float, before_seq: int | None
) -> npt.NDArray[np.void]:
    keep = np.asarray(rows["seq_first"] < (NO_END if before_seq is None else before_seq))
    if keep.any():
        keep &= rows["t_ns"] > rows["t_ns"][keep][-1] - int(seconds * 1e9)
    return rows[keep]
