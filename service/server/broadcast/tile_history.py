"""Force and pressure of each tile over the last minute, per tenth of a second.

Minimum and maximum, so that no peak hides; in half precision, to 0.05 % of the value, which no plot
shows. Memory: 5 kB per tile and 20 kB for the frames' numbers.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from service.server.broadcast.force_history import SECONDS_MAX, select_newest_spans
from service.server.broadcast.force_span import ForceSpan

UNITS = ("force_n", "gauge_kpa")
SPAN_PERIOD_NS = 100_000_000
_SPANS_MAX = int(SECONDS_MAX * 1e9) // SPAN_PERIOD_NS + 2
_ROW = np.dtype([(name, np.int64) for name in ("seq_first", "seq", "n", "t_ns")])
_HALF_MAX = float(np.finfo(np.float16).max)
Halves = npt.NDArray[np.float16]


class TileSpans(NamedTuple):
    """Merged spans: fields of `ForceSpan` (n,), and extremes (n, tiles)."""

    rows: npt.NDArray[np.void]
    minimum: Halves
    maximum: Halves


class TileHistory:
    """Tile extremes over the last minute of a node.

    Args:
        stream_id: stream of the frames.
        tile_count: number of tiles.
    """

    def __init__(self, stream_id: str, tile_count: int) -> None:
        self.stream_id = stream_id
        self.tile_count = tile_count
        self._rows = np.zeros(_SPANS_MAX, _ROW)
        self._extremes: Halves = np.zeros((_SPANS_MAX, 2, len(UNITS), tile_count), np.float16)
        self._count = 0
        """Number of spans ever started in the two rings."""
        self._span_begin_ns = 0

    def add_frames(self, span: ForceSpan, columns: Mapping[str, npt.NDArray[Any]]) -> None:
        """Merge published frames into each tile's minimum and maximum."""
        unknown = np.full((1, self.tile_count), np.nan)
        quantities = [columns.get(unit, unknown).clip(-_HALF_MAX, _HALF_MAX) for unit in UNITS]
        least, greatest = (
            np.array([pick.reduce(values, axis=0) for values in quantities], np.float16)
            for pick in (np.fmin, np.fmax)
        )
        if self._count and span.t_ns_first - self._span_begin_ns < SPAN_PERIOD_NS:
            index = (self._count - 1) % _SPANS_MAX
            row, extremes = self._rows[index], self._extremes[index]
            row["seq"], row["n"], row["t_ns"] = span.seq, row["n"] + span.n, span.t_ns
            np.fmin(extremes[0], least, out=extremes[0])
            np.fmax(extremes[1], greatest, out=extremes[1])
            return
        index, self._span_begin_ns = self._count % _SPANS_MAX, span.t_ns_first
        self._rows[index] = span.seq_first, span.seq, span.n, span.t_ns
        self._extremes[index] = least, greatest
        self._count += 1

    def get_newest_spans(
        self, seconds: float, quantity: str, before_seq: int | None = None
    ) -> TileSpans:
        """Return the newest seconds, oldest first.

        Args:
            seconds: counted back from the newest frame.
            quantity: one of `UNITS`.
            before_seq: only spans that begin before this number.
        """
        indices = np.arange(max(0, self._count - _SPANS_MAX), self._count) % _SPANS_MAX
        rows = self._rows[indices]
        keep = select_newest_spans(rows, seconds, before_seq)
        least, greatest = self._extremes[indices[keep], :, UNITS.index(quantity)].swapaxes(0, 1)
        return TileSpans(rows[keep], least, greatest)
