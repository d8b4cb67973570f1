"""Reference series of a comparison at any zoom: bins with minimum and maximum.

The bins are those of `storage.sessions.pyramid`. A series is read and verified once; then its
coarser levels are in memory, and a zoom reads its row groups only.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from pathlib import Path

import numpy as np
import pyarrow as pa

from storage.schema import Array
from storage.sessions.comparisons import (
    SERIES_NAME,
    read_comparison_series,
    read_comparison_series_footer_unverified,
    read_comparison_series_range,
)
from storage.sessions.footer import read_file_stamps_or_empty
from storage.sessions.pyramid import (
    BINS_PER_COARSER_BIN,
    FRAMES_PER_FINEST_BIN,
    Bins,
    MergedBins,
    build_levels,
    choose_frames_in_bin,
    count_bins,
    merge_bins_within_parts,
    select_bins,
)

GAP_STEPS = 3.5
"""Distance of two frames that counts as a gap, in median steps."""
_BINNED = ("reference_grf_n", "reference_cop_x_m", "reference_cop_y_m")
_SERIES_KEPT = 4


class ComparisonSeries:
    """Series of one comparison, with its coarser levels in memory: 1.3 MB for a million frames.

    Args:
        folder: folder of the comparison.
        table: whole series, just verified.

    Raises:
        DamagedFileError: the file is gone.
        StorageError: it cannot be read now.
    """

    def __init__(self, folder: Path, table: pa.Table) -> None:
        self._folder, self._footer = folder, read_comparison_series_footer_unverified(folder)
        steps = np.diff(table["t_ns"].to_numpy())
        self._gap_ns = GAP_STEPS * float(np.median(steps)) if len(steps) else np.inf
        frames = _make_bins(table, self._gap_ns)
        self._levels = (
            build_levels(merge_bins_within_parts(frames, FRAMES_PER_FINEST_BIN))
            if len(table)
            else []
        )

    def get_bins(self, begin_ns: int | None, end_ns: int | None, min_bins: int) -> MergedBins:
        """Return a slice as `min_bins` to four times as many bins.

        Fewer where there are fewer frames, and more where gaps split them: no bin spans a gap.

        Args:
            begin_ns: begin of the slice, node's UTC; None: of the session.
            end_ns: end of the slice, exclusive; None: of the session.
            min_bins: least number of bins.

        Returns:
            `t_first_ns`, `t_last_ns`, `frames`, `missing` (number of gaps in the bin or just before
            it), and `_min` and `_max` of the reference and of `error_n`, ours minus the reference,
            NaN where unknown.

        Raises:
            DamagedFileError: a row group is damaged.
            StorageError: it cannot be read now.
        """
        for above in reversed(range(len(self._levels))):
            found = select_bins(self._levels[above], begin_ns, end_ns)
            if len(found["frames"]) >= min_bins:
                return MergedBins(found, FRAMES_PER_FINEST_BIN * BINS_PER_COARSER_BIN**above)
        bins = _make_bins(
            read_comparison_series_range(self._folder, self._footer, begin_ns, end_ns), self._gap_ns
        )
        size = choose_frames_in_bin(count_bins(bins), min_bins)
        return MergedBins(merge_bins_within_parts(bins, size), size)


class ComparisonSeriesCache:
    """Cache of the most recently used series, while their files are unchanged."""

    def __init__(self) -> None:
        self._entries: OrderedDict[Path, tuple[tuple[int, ...], ComparisonSeries]] = OrderedDict()
        self._one_at_a_time = threading.Lock()

    def get_or_read(self, folder: Path) -> ComparisonSeries | None:
        """Return the series of a comparison, read if it is not cached; None: it has none.

        Raises:
            DamagedFileError: the file is damaged.
            StorageError: it cannot be read now.
        """
        path = folder / SERIES_NAME
        with self._one_at_a_time:
            stamps = read_file_stamps_or_empty(path)
            cached = self._entries.pop(path, None)
            if cached is None or cached[0] != stamps:
                table = read_comparison_series(folder)
                if table is None:
                    return None
                cached = stamps, ComparisonSeries(folder, table)
            self._entries[path] = cached
            while len(self._entries) > _SERIES_KEPT:
                self._entries.popitem(last=False)
            return cached[1]


def _make_bins(table: pa.Table, gap_ns: float) -> Bins:
    """Return a bin for each frame; gaps separate parts."""
    t_ns: Array = table["t_ns"].to_numpy()
    gaps = np.zeros(len(t_ns), np.bool_)
    gaps[1:] = np.diff(t_ns) > gap_ns
    bins: Bins = {
        "t_first_ns": t_ns,
        "t_last_ns": t_ns,
        "part": np.cumsum(gaps).astype(np.uint16),  # only neighbours have to differ
        "frames": np.ones(len(t_ns), np.uint32),
        "missing": gaps.astype(np.uint32),
    }
    values = {name: table[name].to_numpy().astype(np.float32) for name in _BINNED}
    values["error_n"] = table["grf_n"].to_numpy() - values["reference_grf_n"]
    for name, column in values.items():
        bins |= {f"{name}_min": column, f"{name}_max": column}
    return bins
