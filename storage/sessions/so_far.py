"""Preview bins of an unsealed session: at most a fixed number, coarser the longer it is."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from storage.schema import Array
from storage.sessions.pyramid import FACTOR, Bins, bins_of_frames, joined, merged, starts_of

MOST = 16_384
"""Most stored bins: with eight tiles 154 bytes each, with 64 tiles 658."""
_PENDING = 1024
"""Frames that are merged at a time."""


_NONE = np.empty(0, np.int64)


class BinsSoFar:
    """Bins of consecutive frames, at most `most`; each covers more frames as the session grows.

    Attributes:
        frames_in_bin: frames per bin; 1: the bins are single frames.
        frames: number of added frames.
    """

    def __init__(self, most: int = MOST) -> None:
        self.frames_in_bin = 1
        self.frames = 0
        self._most = most
        self._bins: list[Bins] = []
        self._pending: list[Bins] = []
        self._before: tuple[int, int] | None = None
        """Part and number of the last frame."""

    def feed(self, frames: Mapping[str, Array], *, there: int = 0) -> int:
        """Add the next frames.

        Args:
            frames: `storage.sessions.pyramid.frame_columns`, and `part`.
            there: number of leading frames that were added before.

        Returns:
            How many of these frames were.
        """
        if there and len(frames["seq"]):
            there = min(there, len(frames["seq"]))
            self._before = int(frames["part"][there - 1]), int(frames["seq"][there - 1])
            frames = {name: values[there:] for name, values in frames.items()}
        if not len(frames["seq"]):
            return there
        part = int(frames["part"][0])
        before = self._before[1] if self._before is not None and self._before[0] == part else None
        self._before = int(frames["part"][-1]), int(frames["seq"][-1])
        self._pending.append(bins_of_frames(frames, before))
        self.frames += len(frames["seq"])
        if sum(_length(piece) for piece in self._pending) >= max(_PENDING, self.frames_in_bin):
            self._close_full()
        return there

    def cut(self, most: int) -> int:
        """Drop all but the first frames: those of full bins, at most `most`.

        Returns:
            The number of frames left. The last of them has to be added again before the next one.
        """
        bins = joined(self._bins) if self._bins else None
        ends = np.cumsum(bins["frames"], dtype=np.int64) if bins is not None else _NONE
        count = int(np.searchsorted(ends, most, side="right"))
        self._bins = [_rows(bins, 0, count)] if bins is not None and count else []
        self._pending, self._before = [], None
        self.frames = int(ends[count - 1]) if count else 0
        return self.frames

    def bins(self) -> Bins | None:
        """Return all bins until now, the last one perhaps not full; None before the first frame."""
        rest = [self._merged(joined(self._pending))] if self._pending else []
        pieces = [*self._bins, *rest]
        return joined(pieces) if pieces else None

    def _merged(self, frames: Bins) -> Bins:
        return frames if self.frames_in_bin == 1 else merged(frames, self.frames_in_bin)

    def _close_full(self) -> None:
        """Merge pending frames, except those of a bin that is not full yet."""
        frames = joined(self._pending)
        last = int(starts_of(frames["part"], self.frames_in_bin)[-1])
        end = len(frames["part"])
        full = end if end - last == self.frames_in_bin else last
        self._pending = [_rows(frames, full, end)] if full < end else []
        if full:
            self._bins.append(self._merged(_rows(frames, 0, full)))
        if sum(map(_length, self._bins)) > self._most:
            self._bins = [merged(joined(self._bins), FACTOR)]
            self.frames_in_bin *= FACTOR


def thinned(bins: Bins, begin_ns: int | None, end_ns: int | None, most: int) -> tuple[Bins, int]:
    """Return the bins of a time range, merged to at most `most`, and how many make one."""
    rows = np.ones(_length(bins), dtype=np.bool_)
    if begin_ns is not None:
        rows &= bins["t_last_ns"] >= begin_ns
    if end_ns is not None:
        rows &= bins["t_first_ns"] < end_ns
    found, count = {name: values[rows] for name, values in bins.items()}, 1
    while _length(found) > most:
        found, count = merged(found, FACTOR), count * FACTOR
        if count > len(rows):  # parts of a bin each
            break
    return found, count


def _rows(bins: Bins, begin: int, end: int) -> Bins:
    return {name: values[begin:end].copy() for name, values in bins.items()}


def _length(bins: Bins) -> int:
    return len(bins["part"])
