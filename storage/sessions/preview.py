"""Preview bins of an unsealed session: at most a fixed number, coarser the longer it is."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from storage.schema import Array
from storage.sessions.pyramid import (
    BINS_PER_COARSER_BIN,
    Bins,
    MergedBins,
    concatenate_bins,
    find_group_starts,
    make_single_frame_bins,
    merge_bins,
)

MAX_PREVIEW_BINS = 16_384
"""Most stored bins: with eight tiles 154 bytes each, with 64 tiles 658."""
_MIN_MERGED_FRAMES = 1024
"""Frames that are merged at a time."""


_NONE = np.empty(0, np.int64)


class PreviewBins:
    """Bins of consecutive frames, at most `max_bins`; each covers more frames as the session grows.

    Attributes:
        frames_in_bin: frames per bin; 1: the bins are single frames.
        frame_count: number of added frames.
    """

    def __init__(self, max_bins: int = MAX_PREVIEW_BINS) -> None:
        self.frames_in_bin = 1
        self.frame_count = 0
        self._most = max_bins
        self._bins: list[Bins] = []
        self._pending: list[Bins] = []
        self._last_frame: tuple[int, int] | None = None
        """Part and number of the last frame."""

    def add_frames(self, frames: Mapping[str, Array], *, already_added: int = 0) -> None:
        """Add the next frames, apart from leading ones that were added before.

        Args:
            frames: `storage.sessions.pyramid.required_frame_columns`, and `part`.
            already_added: number of leading frames that were added before, at most all.
        """
        if already_added:
            self._last_frame = (
                int(frames["part"][already_added - 1]),
                int(frames["seq"][already_added - 1]),
            )
            frames = {name: values[already_added:] for name, values in frames.items()}
        if not len(frames["seq"]):
            return
        part = int(frames["part"][0])
        before = (
            self._last_frame[1]
            if self._last_frame is not None and self._last_frame[0] == part
            else None
        )
        self._last_frame = int(frames["part"][-1]), int(frames["seq"][-1])
        self._pending.append(make_single_frame_bins(frames, before))
        self.frame_count += len(frames["seq"])
        if sum(_count_bins(piece) for piece in self._pending) >= max(
            _MIN_MERGED_FRAMES, self.frames_in_bin
        ):
            self._merge_full_bins()

    def truncate_to_full_bins(self, max_frames: int) -> int:
        """Drop all but the first frames: those of full bins, at most `max_frames`.

        Returns:
            The number of frames left. The last of them has to be added again before the next one.
        """
        bins = concatenate_bins(self._bins) if self._bins else None
        ends = np.cumsum(bins["frames"], dtype=np.int64) if bins is not None else _NONE
        count = int(np.searchsorted(ends, max_frames, side="right"))
        self._bins = [_copy_rows(bins, 0, count)] if bins is not None and count else []
        self._pending, self._last_frame = [], None
        self.frame_count = int(ends[count - 1]) if count else 0
        return self.frame_count

    def get_bins(self) -> Bins | None:
        """Return all bins until now, the last one perhaps not full; None before the first frame."""
        rest = [self._merge_to_bins(concatenate_bins(self._pending))] if self._pending else []
        pieces = [*self._bins, *rest]
        return concatenate_bins(pieces) if pieces else None

    def _merge_to_bins(self, frames: Bins) -> Bins:
        return frames if self.frames_in_bin == 1 else merge_bins(frames, self.frames_in_bin)

    def _merge_full_bins(self) -> None:
        """Merge pending frames, except those of a bin that is not full yet."""
        frames = concatenate_bins(self._pending)
        last = int(find_group_starts(frames["part"], self.frames_in_bin)[-1])
        end = len(frames["part"])
        full = end if end - last == self.frames_in_bin else last
        self._pending = [_copy_rows(frames, full, end)] if full < end else []
        if full:
            self._bins.append(self._merge_to_bins(_copy_rows(frames, 0, full)))
        if sum(map(_count_bins, self._bins)) > self._most:
            self._bins = [merge_bins(concatenate_bins(self._bins), BINS_PER_COARSER_BIN)]
            self.frames_in_bin *= BINS_PER_COARSER_BIN


def select_and_downsample_bins(
    bins: Bins, begin_ns: int | None, end_ns: int | None, max_bins: int
) -> MergedBins:
    """Return a time range's bins, merged to about `max_bins`."""
    rows = np.ones(_count_bins(bins), dtype=np.bool_)
    if begin_ns is not None:
        rows &= bins["t_last_ns"] >= begin_ns
    if end_ns is not None:
        rows &= bins["t_first_ns"] < end_ns
    found, count = {name: values[rows] for name, values in bins.items()}, 1
    while _count_bins(found) > max_bins:
        found, count = merge_bins(found, BINS_PER_COARSER_BIN), count * BINS_PER_COARSER_BIN
        if count > len(rows):  # parts of a bin each
            break
    return MergedBins(found, count)


def _copy_rows(bins: Bins, begin: int, end: int) -> Bins:
    return {name: values[begin:end].copy() for name, values in bins.items()}


def _count_bins(bins: Bins) -> int:
    return len(bins["part"])
