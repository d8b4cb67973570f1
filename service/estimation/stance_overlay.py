"""Overlay of stances, time-normalized to 0 to 100 % of their durations.

The only definition of this normalization. A stance lasts from its first frame to its last
(`service.estimation.stances`). A value between two frames lies on the straight line between them,
and is NaN if either frame is.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from devices.arrays import Floats, Times

OVERLAY_COLUMNS = ("grf_n", "cop_x_m", "cop_y_m")
"""Columns of estimates in the overlay."""

Columns = Mapping[str, npt.NDArray[Any]]


@dataclass(frozen=True)
class CurveStatistics:
    """Statistics of one quantity over all stances, (points,) each.

    Attributes:
        mean: over the stances with a value; NaN without any.
        sd: sample standard deviation over these; NaN for fewer than two.
        count: number of these stances.
    """

    mean: Floats
    sd: Floats
    count: npt.NDArray[np.int64]


@dataclass(frozen=True)
class Overlay:
    """Overlay of stances.

    Attributes:
        statistics: statistics by column.
        rows: (k,), indices of the stances with single curves.
        curves: by column, (k, points), these curves.
    """

    statistics: Mapping[str, CurveStatistics]
    rows: npt.NDArray[np.int64]
    curves: Mapping[str, Floats]


def select_evenly(count: int, max_count: int) -> npt.NDArray[np.int64]:
    """Return at most `max_count` of `count` indices: first, last, and evenly in between."""
    if count <= max_count:
        return np.arange(count)
    return np.round(np.linspace(0, count - 1, max_count)).astype(np.int64)


def resample_stance(t_ns: Times, values: Floats, points: int) -> Floats:
    """Resample one stance at `points` percentages from 0 to 100, (points, ...).

    Args:
        t_ns: (n,), instants of its frames, rising, n of 2 or more.
        values: (n, ...), in these frames.
        points: number of points, 2 or more.
    """
    share = (t_ns - t_ns[0]) / float(t_ns[-1] - t_ns[0])
    at = np.linspace(0.0, 1.0, points)
    behind = np.clip(np.searchsorted(share, at), 1, len(share) - 1)
    before = behind - 1
    wide = (slice(None), *(None,) * (values.ndim - 1))
    part = ((at - share[before]) / (share[behind] - share[before]))[wide]
    low, high = values[before], values[behind]
    # Exactly at a frame its value counts, even beside a NaN.
    between = np.where(part >= 1.0, high, low + (high - low) * part)
    return np.asarray(np.where(part <= 0.0, low, between))


class StanceOverlayBuilder:
    """Accumulator of stances from consecutive frames; the result does not depend on the batches.

    It stores sums, and the curves of some stances: its memory does not grow with their number.
    """

    def __init__(
        self,
        part: npt.NDArray[Any],
        begin_t_ns: Times,
        end_t_ns: Times,
        *,
        points: int,
        rows: Collection[int],
    ) -> None:
        """Set the stances and the points.

        Args:
            part: (m,), part of each stance, in the order of the frames.
            begin_t_ns: (m,), instant of its first frame.
            end_t_ns: (m,), instant of its last frame, later than the first.
            points: number of percentages from 0 to 100, both included.
            rows: indices of the stances with single curves.
        """
        self._windows = list(
            zip(part.tolist(), begin_t_ns.tolist(), end_t_ns.tolist(), strict=True)
        )
        self._next = 0
        self._open: list[tuple[Times, Floats]] = []
        self._points = points
        self._wanted = frozenset(int(row) for row in rows)
        self._kept: list[tuple[int, Floats]] = []
        shape = (points, len(OVERLAY_COLUMNS))
        self._count = np.zeros(shape, np.int64)
        self._mean, self._squares = np.zeros(shape), np.zeros(shape)

    def add_frames(self, t_ns: Times, columns: Columns) -> None:
        """Add the next n frames.

        Args:
            t_ns: (n,), instants, rising within a part.
            columns: `OVERLAY_COLUMNS`, (n,) each; `part`, 0 if absent.
        """
        if not len(t_ns) or self._next >= len(self._windows):
            return
        part = columns["part"] if "part" in columns else np.zeros(len(t_ns), np.uint16)
        values = np.stack([columns[name].astype(np.float64) for name in OVERLAY_COLUMNS], axis=1)
        edges = [0, *(np.flatnonzero(np.diff(part)) + 1).tolist(), len(part)]
        for first, end in pairwise(edges):
            self._add_part_frames(int(part[first]), t_ns[first:end], values[first:end])

    def build_overlay(self) -> Overlay:
        """Return the overlay of all stances that are complete."""
        known = self._count > 0
        mean = np.where(known, self._mean, np.nan)
        several = self._count > 1
        sd = np.sqrt(np.where(several, self._squares / np.maximum(1, self._count - 1), np.nan))
        spread = {
            name: CurveStatistics(mean[:, i], sd[:, i], self._count[:, i])
            for i, name in enumerate(OVERLAY_COLUMNS)
        }
        rows = np.array([row for row, _ in self._kept], np.int64)
        empty = np.empty((0, self._points, len(OVERLAY_COLUMNS)))
        curves = np.stack([curve for _, curve in self._kept]) if self._kept else empty
        return Overlay(
            spread, rows, {name: curves[:, :, i] for i, name in enumerate(OVERLAY_COLUMNS)}
        )

    def _add_part_frames(self, part: int, t_ns: Times, values: Floats) -> None:
        while self._next < len(self._windows):
            of, begin_ns, end_ns = self._windows[self._next]
            if of != part or begin_ns > t_ns[-1]:
                return
            rows = slice(
                int(np.searchsorted(t_ns, begin_ns)),
                int(np.searchsorted(t_ns, end_ns, side="right")),
            )
            self._open.append((t_ns[rows], values[rows]))
            if t_ns[-1] < end_ns:
                return
            self._add_stance()

    def _add_stance(self) -> None:
        row, pieces = self._next, self._open
        self._next, self._open = row + 1, []
        t_ns = np.concatenate([piece for piece, _ in pieces])
        values = np.concatenate([piece for _, piece in pieces])
        curve = resample_stance(t_ns, values, self._points)
        if row in self._wanted:
            self._kept.append((row, curve))
        # Welford (1962): no cancellation for any number of stances.
        known = np.isfinite(curve)
        self._count += known
        off = np.where(known, curve - self._mean, 0.0)
        self._mean += off / np.maximum(1, self._count)
        self._squares += np.where(known, off * (curve - self._mean), 0.0)
