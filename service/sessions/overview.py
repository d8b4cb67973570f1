"""Overviews at any zoom: of a sealed session, and of the reference series of a comparison.

For a slice and a number of points they return bins of the coarsest level with enough bins; beyond
the finest level, bins of the frames themselves. A session's overview is built while frames are
written, or rebuilt later. A series is read and verified once; then its coarser levels are in
memory, and a zoom reads its row groups only.
"""

from __future__ import annotations

import logging
import threading
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa

from devices.errors import DamagedFileError, FileFormatError, FootTileError, StorageError
from devices.frames import FrameBatch
from storage.formats.slice import Slice
from storage.schema import Array
from storage.sessions.comparisons import (
    SERIES_NAME,
    read_comparison_series,
    read_comparison_series_footer_unverified,
    read_comparison_series_range,
)
from storage.sessions.footer import read_file_stamps_or_empty
from storage.sessions.overview import (
    OVERVIEW_NAME,
    OverviewReader,
    encode_overview,
    open_overview,
    write_overview,
)
from storage.sessions.pyramid import (
    BINS_PER_COARSER_BIN,
    FRAMES_PER_FINEST_BIN,
    BinBuilder,
    Bins,
    MergedBins,
    bin_column_types,
    bin_source_columns,
    build_levels,
    choose_frames_in_bin,
    count_bins,
    merge_bins_within_parts,
    select_bins,
    shift_bins_to_axis,
)
from storage.sessions.reader import SealedFileReader
from storage.sessions.time_axis import TimeAxis

log = logging.getLogger("foottile.overview")

POINTS_MAX = 8000
_VALUES_MAX = 1 << 18
"""Values read at once for a zoom into frames: 2 MiB."""
_NOT_WRITTEN = f"{OVERVIEW_NAME} was not written, and is rebuilt on request"


class OverviewWriter:
    """Builder of the overview of frames that are being sealed.

    A failure does not affect the session: it is reported, and the overview is rebuilt later.

    Attributes:
        problem: reason why it is missing; None: it is written.
    """

    def __init__(self, tiles: int) -> None:
        self.problem: str | None = None
        self._tiles = tiles
        self._pyramid = BinBuilder(FRAMES_PER_FINEST_BIN)

    def try_add_frames(self, frames: FrameBatch, columns: Mapping[str, Array]) -> None:
        """Add the next frames with their columns."""
        if self.problem is not None:
            return
        try:
            wanted = bin_source_columns(has_estimates="grf_n" in columns)
            given_columns = {name: columns[name] for name in (*wanted, "part") if name in columns}
            frame_fields = {
                name: getattr(frames, name) for name in wanted if name not in given_columns
            }
            self._pyramid.add_frames(given_columns | frame_fields)
        except Exception as error:  # never fail a session for a derived file
            log.exception("overview: this is a bug")
            self.problem = f"{_NOT_WRITTEN}: {error}"

    def try_write_file(self, folder: Path, frames_sha256: str) -> None:
        """Try to write `overview.arrow`; a failure is reported in `problem`."""
        if self.problem is not None:
            return
        try:
            levels = self._pyramid.pop_levels()
            path = folder / OVERVIEW_NAME
            write_overview(path, levels, tile_count=self._tiles, frames_sha256=frames_sha256)
        except Exception as error:
            if not isinstance(error, FootTileError):
                log.exception("overview: this is a bug")
            self.problem = f"{_NOT_WRITTEN}: {error}"


@dataclass(frozen=True)
class BinnedSlice:
    """Slice of a session as bins.

    Attributes:
        bins: bins as in `storage.sessions.pyramid`, in the order of the file, times on the time
            axis.
        frames_per_bin: number of frames per bin; 1: these are the frames themselves.
        begin_ns: `t_ns` of the session's first frame.
        end_ns: last time on the axis.
        time_axis: time axis of the session.
    """

    bins: Bins
    frames_per_bin: int
    begin_ns: int
    end_ns: int
    time_axis: TimeAxis


def bin_from_overview_or_rebuild(
    session: SealedFileReader, time_slice: Slice, min_bins: int, *, frames_sha256: str
) -> BinnedSlice:
    """Return a slice of a sealed session as `min_bins` to four times as many bins.

    Fewer only where there are fewer frames. A missing, damaged or outdated overview is rebuilt, and
    stored if the folder is writable.

    Args:
        session: frames of the session, open for slices.
        time_slice: time interval; its columns are ignored.
        min_bins: least number of bins.
        frames_sha256: hash of the file of frames.

    Raises:
        FileFormatError: the frames are damaged.
    """
    path = session.path.with_name(OVERVIEW_NAME)
    begin_ns, end_ns = session.read_span_on_axis_ns()
    bounds = time_slice.compute_bounds_ns(begin_ns)
    try:
        with open_overview(path) as stored:
            found = _bins_from_levels(stored, frames_sha256, bounds, min_bins, session.time_axis)
    except (FileNotFoundError, FileFormatError, StorageError):
        with _rebuild(path, session, frames_sha256) as made:
            found = _bins_from_levels(made, frames_sha256, bounds, min_bins, session.time_axis)
    if isinstance(found, int):
        found = _bins_from_frames(session, time_slice, begin_ns, min_bins, found)
    bins, size = found
    return BinnedSlice(bins, size, begin_ns, end_ns, session.time_axis)


def _bins_from_levels(
    overview: OverviewReader,
    frames_sha256: str,
    bounds: tuple[int | None, int | None],
    points: int,
    axis: TimeAxis,
) -> tuple[Bins, int] | int:
    """Return bins of the coarsest level with enough bins, and the frames per bin.

    If no level has enough: the approximate number of frames.

    Raises:
        DamagedFileError: a chunk is damaged, or the overview is of other frames.
    """
    if overview.index.frames_sha256 != frames_sha256:
        raise DamagedFileError("is of other frames")
    for level in reversed(range(overview.index.level_count)):
        if overview.estimate_bin_count(level, *bounds, axis) >= points:
            bins = overview.read_bins(level, *bounds, axis)
            if len(bins["part"]) >= points:
                return bins, FRAMES_PER_FINEST_BIN * BINS_PER_COARSER_BIN**level
    return FRAMES_PER_FINEST_BIN * len(overview.read_bins(0, *bounds, axis)["part"])


def _bins_from_frames(
    session: SealedFileReader, part: Slice, begin_ns: int, points: int, rows: int
) -> tuple[Bins, int]:
    """Return bins of 16, 4 or 1 frames, and the frames per bin."""
    builder = BinBuilder(choose_frames_in_bin(rows, points))
    names = _list_source_columns(session)
    groups = session.find_overlapping_row_groups(*part.compute_bounds_ns(begin_ns))
    for piece in session.read_quantities(*names, row_groups=groups, max_values=_VALUES_MAX):
        inside = part.compute_row_mask(
            session.time_axis.shift_to_axis(piece["t_ns"], piece.get("part")), begin_ns
        )
        builder.add_frames({name: values[inside] for name, values in piece.items()})
    types = bin_column_types(len(session.info.tiles), has_estimates="grf_n" in names)
    bins = builder.get_bins() or {name: np.empty(0, type_) for name, type_ in types.items()}
    bins = shift_bins_to_axis({name: bins[name] for name in types}, session.time_axis)
    return bins, builder.frames_in_bin


def _list_source_columns(session: SealedFileReader) -> tuple[str, ...]:
    part = ("part",) if session.has_columns("part") else ()
    return *bin_source_columns(has_estimates=session.has_columns("grf_n")), *part


def _rebuild(path: Path, session: SealedFileReader, frames_sha256: str) -> OverviewReader:
    """Rebuild the overview, and store it if the folder is writable."""
    pyramid, tiles = BinBuilder(FRAMES_PER_FINEST_BIN), len(session.info.tiles)
    for piece in session.read_quantities(*_list_source_columns(session)):
        pyramid.add_frames(piece)
    levels = pyramid.pop_levels()
    try:
        write_overview(path, levels, tile_count=tiles, frames_sha256=frames_sha256)
        return open_overview(path)
    except (FileNotFoundError, FileFormatError, StorageError):
        content = encode_overview(levels, tile_count=tiles, frames_sha256=frames_sha256)
        return OverviewReader(pa.BufferReader(content), where=str(path))


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
