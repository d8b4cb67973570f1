"""Frames at every zoom: bins with minimum and maximum of each column, so that no peak is lost.

A bin covers consecutive frames of one part of a session: single frames are bins as well. Bins are
merged to coarser ones, 64 frames at first and then four bins at a time. Minimum and maximum of a
merged bin are exactly those of its frames, in whatever order they were merged.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from devices.flags import CONTACT_UNKNOWN
from devices.frames import NOT_READ
from storage.schema import Array
from storage.sessions.time_axis import TimeAxis

FRAMES_PER_FINEST_BIN = 64
"""Frames of a bin of the finest stored level."""
BINS_PER_COARSER_BIN = 4
"""Bins of one level that are merged to one of the next."""
MAX_COARSEST_BINS = 512
"""Most bins of the coarsest level."""
INTERVAL_95 = 1.96

CONTACT_ABSENT, CONTACT_PRESENT, CONTACT_UNCERTAIN = 1, 2, 4
"""Bits of `contact`: some frames without contact, with contact, with unknown contact."""

Bins = dict[str, Array]
"""Columns of bins by name, n rows each."""

_COMMON_COLUMNS = (
    *("t_first_ns", "t_last_ns", "part", "frames", "missing", "frame_flags"),
    *("grf_n_min", "grf_n_max", "grf_n_max_t_ns", "grf_low_n_min", "grf_high_n_max"),
    *(
        "grf_lower_bound_n_max",
        "grf_unknown",
        "cop_x_m_min",
        "cop_x_m_max",
        "cop_y_m_min",
        "cop_y_m_max",
    ),
    *("cop_x_low_m_min", "cop_x_high_m_max", "cop_y_low_m_min", "cop_y_high_m_max"),
    *("angle_rad_min", "angle_rad_max", "contact", "estimate_flags"),
)
"""Columns of every array; those of each tile follow."""
_TILE_ESTIMATE_COLUMNS = ("force_n_{i}_min", "force_n_{i}_max")
_TILE_RAW_COLUMNS = ("pressure_raw_{i}_min", "pressure_raw_{i}_max")
_TILE_FLAGS_COLUMN = "tile_flags_{i}"
_SUMMED_COLUMNS = frozenset({"frames", "missing", "grf_unknown"})
_BIT_COLUMNS = frozenset({"frame_flags", "contact", "estimate_flags"})
_INTEGER_TYPES: Mapping[str, npt.DTypeLike] = {
    "t_first_ns": np.int64,
    "t_last_ns": np.int64,
    "grf_n_max_t_ns": np.int64,
    "part": np.uint16,
    "frames": np.uint32,
    "missing": np.uint64,
    "grf_unknown": np.uint32,
    "frame_flags": np.uint8,
    "contact": np.uint8,
    "estimate_flags": np.uint16,
}


def bin_column_types(tiles: int, *, has_estimates: bool) -> dict[str, np.dtype[Any]]:
    """Return names and types of a bin's columns.

    `missing` counts frame numbers without a frame, in the bin or just before it. `grf_low_n_min`
    and `grf_high_n_max` bound the 95 % intervals of all its frames, those of `cop_x` and `cop_y` as
    well; `grf_unknown` counts frames without a GRF. Without estimates there are raw counts in place
    of forces, and otherwise only columns of frames.
    """
    names = [name for name in _COMMON_COLUMNS if has_estimates or not _is_estimate(name)]
    for i in range(tiles):
        names += [
            name.format(i=i)
            for name in (
                *(_TILE_ESTIMATE_COLUMNS if has_estimates else _TILE_RAW_COLUMNS),
                _TILE_FLAGS_COLUMN,
            )
        ]
    return {name: np.dtype(_column_type(name)) for name in names}


def _is_estimate(name: str) -> bool:
    return name.startswith(("grf", "cop", "angle", "contact", "estimate"))


def _column_type(name: str) -> npt.DTypeLike:
    return np.uint8 if name.startswith("tile_flags_") else _INTEGER_TYPES.get(name, np.float32)


def bin_source_columns(*, has_estimates: bool) -> tuple[str, ...]:
    """Return the columns of frames that bins are made of, by logical name; `part` is optional."""
    same = ("seq", "t_ns", "tile_flags", "frame_flags")
    if not has_estimates:
        return (*same, "pressure_raw")
    return (
        *same,
        *("grf_n", "grf_sigma_n", "grf_lower_bound_n", "angle_rad"),
        *("cop_x_m", "cop_y_m", "cop_sigma_x_m", "cop_sigma_y_m"),
        *("contact", "estimate_flags", "force_n"),
    )


def make_single_frame_bins(frames: Mapping[str, Array], previous_seq: int | None = None) -> Bins:
    """Make a bin of each single frame.

    Args:
        frames: `bin_source_columns`, (n,) or (n, tiles); `part` if there are several.
        previous_seq: number of the frame before the first one, if it is of the same part.
    """
    seq, n = frames["seq"], len(frames["seq"])
    part = frames["part"] if "part" in frames else np.zeros(n, np.uint16)
    missing = np.zeros(n, np.uint64)
    missing[1:] = np.where(part[1:] == part[:-1], seq[1:] - seq[:-1] - np.uint64(1), 0)
    if n and previous_seq is not None:
        missing[0] = seq[0] - np.uint64(previous_seq) - np.uint64(1)
    bins: Bins = {
        "t_first_ns": frames["t_ns"],
        "t_last_ns": frames["t_ns"],
        "part": part.astype(np.uint16),
        "frames": np.ones(n, np.uint32),
        "missing": missing,
        "frame_flags": frames["frame_flags"],
    }
    estimated = "grf_n" in frames
    if estimated:
        contact = frames["contact"]
        bins |= {
            "grf_n_max_t_ns": frames["t_ns"],
            "grf_lower_bound_n_max": frames["grf_lower_bound_n"].astype(np.float32),
            "grf_unknown": np.isnan(frames["grf_n"]).astype(np.uint32),
            "contact": np.select(
                [contact == CONTACT_UNKNOWN, contact == 0],
                [CONTACT_UNCERTAIN, CONTACT_ABSENT],
                CONTACT_PRESENT,
            ).astype(np.uint8),
            "estimate_flags": frames["estimate_flags"],
        }
        for name in ("grf_n", "cop_x_m", "cop_y_m", "angle_rad"):
            bins |= _as_min_max(name, frames[name].astype(np.float32))
        bins |= _interval_ends("grf_{}_n", frames["grf_n"], frames["grf_sigma_n"])
        for axis in ("x", "y"):
            place_m, sigma_m = frames[f"cop_{axis}_m"], frames[f"cop_sigma_{axis}_m"]
            bins |= _interval_ends(f"cop_{axis}_{{}}_m", place_m, sigma_m)
    for i in range(frames["tile_flags"].shape[1]):
        bins[f"tile_flags_{i}"] = frames["tile_flags"][:, i]
        if estimated:
            bins |= _as_min_max(f"force_n_{i}", frames["force_n"][:, i].astype(np.float32))
        else:
            counts = frames["pressure_raw"][:, i].astype(np.float32)
            counts[frames["pressure_raw"][:, i] == NOT_READ] = np.nan
            bins |= _as_min_max(f"pressure_raw_{i}", counts)
    return bins


def _as_min_max(name: str, values: Array) -> Bins:
    return {f"{name}_min": values, f"{name}_max": values}


def _interval_ends(name: str, values: Array, sigmas: Array) -> Bins:
    """Return the ends of 95 % intervals; `{}` in `name` becomes `low` and `high`."""
    middle = values.astype(np.float32)
    half = np.float32(INTERVAL_95) * sigmas.astype(np.float32)
    return {f"{name.format('low')}_min": middle - half, f"{name.format('high')}_max": middle + half}


class MergedBins(NamedTuple):
    """Bins, and how many frames or finer bins one has at most."""

    bins: Bins
    group_size: int


def merge_bins_within_parts(bins: Bins, group_size: int) -> Bins:
    """Merge `group_size` bins at a time, or fewer at the end of a part."""
    if not count_bins(bins) or group_size == 1:
        return bins
    return _merge_groups(bins, _find_group_starts(bins["part"], group_size))


def _find_group_starts(part: Array, group_size: int) -> npt.NDArray[np.intp]:
    """Return the first index of each group of `group_size`; no group extends over two parts."""
    n = len(part)
    begins = np.flatnonzero(np.r_[True, part[1:] != part[:-1]])
    since = np.arange(n) - np.repeat(begins, np.diff(np.r_[begins, n]))
    return np.flatnonzero(since % group_size == 0)


def _merge_groups(bins: Bins, starts: npt.NDArray[np.intp]) -> Bins:
    ends = np.r_[starts[1:], len(bins["part"])] - 1
    found: Bins = {}
    for name, values in bins.items():
        if name == "t_last_ns":
            found[name] = values[ends]
        elif name == "grf_n_max_t_ns":
            found[name] = values[_find_maxima(bins["grf_n_max"], starts)]
        elif name in {"t_first_ns", "part"}:
            found[name] = values[starts]
        elif name in _SUMMED_COLUMNS:
            found[name] = np.add.reduceat(values, starts)
        elif name in _BIT_COLUMNS or name.startswith("tile_flags_"):
            found[name] = np.bitwise_or.reduceat(values, starts)
        elif name.endswith("_min"):
            found[name] = np.fmin.reduceat(values, starts)
        else:
            found[name] = np.fmax.reduceat(values, starts)
    return found


def _find_maxima(values: Array, starts: npt.NDArray[np.intp]) -> npt.NDArray[np.intp]:
    """Return the index of the first maximum of each group; its first index if all are NaN."""
    maxima = np.repeat(np.fmax.reduceat(values, starts), np.diff(np.r_[starts, len(values)]))
    at = np.where(values == maxima, np.arange(len(values)), len(values))
    found = np.minimum.reduceat(at, starts)
    return np.where(found < len(values), found, starts)


def concatenate_bins(pieces: list[Bins]) -> Bins:
    """Concatenate bins."""
    return {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}


def shift_bins_to_axis(bins: Bins, axis: TimeAxis) -> Bins:
    """Return bins with their instants on the session's time axis."""
    names = ("t_first_ns", "t_last_ns", *({"grf_n_max_t_ns"} & bins.keys()))
    return bins | {name: axis.shift_to_axis(bins[name], bins["part"]) for name in names}


def build_levels(finest: Bins) -> list[Bins]:
    """Return a level and its coarser ones, until one has at most `MAX_COARSEST_BINS` bins."""
    levels = [finest]
    while count_bins(levels[-1]) > MAX_COARSEST_BINS:
        levels.append(merge_bins_within_parts(levels[-1], BINS_PER_COARSER_BIN))
        if count_bins(levels[-1]) == count_bins(levels[-2]):  # parts of a bin each
            levels.pop()
            break
    return levels


MAX_PREVIEW_BINS = 16_384
"""Most bins of a preview: with eight tiles 178 bytes each, with 64 tiles 682."""
_MIN_MERGED_FRAMES = 1024
"""Frames that are merged at a time."""


class BinBuilder:
    """Builder of bins from consecutive frames.

    The bins do not depend on how frames are cut into pieces, unless `max_bins` is exceeded.

    Args:
        frames_in_bin: frames per bin; 1: the bins are single frames.
        max_bins: beyond it, bins are merged to coarser ones; None: no limit.

    Attributes:
        frames_in_bin: frames per bin by now.
        frame_count: number of added frames.
    """

    def __init__(self, frames_in_bin: int = 1, max_bins: int | None = None) -> None:
        self.frames_in_bin = frames_in_bin
        self.frame_count = 0
        self._max_bins = max_bins
        self._bins: list[Bins] = []
        self._pending: list[Bins] = []
        """Single frames that are not merged yet."""
        self._last_frame: tuple[int, int] | None = None
        """Part and number of the last frame."""

    def add_frames(self, frames: Mapping[str, Array], *, already_added: int = 0) -> None:
        """Add the next frames, apart from leading ones that were added before.

        Args:
            frames: `bin_source_columns`, and `part` if there are several.
            already_added: number of leading frames that were added before, at most all.
        """
        if already_added:
            self._last_frame = _frame_at(frames, already_added - 1)
            frames = {name: values[already_added:] for name, values in frames.items()}
        if not len(frames["seq"]):
            return
        part, _ = _frame_at(frames, 0)
        last_part, last_seq = self._last_frame or (None, None)
        self._pending.append(
            make_single_frame_bins(frames, last_seq if last_part == part else None)
        )
        self._last_frame = _frame_at(frames, -1)
        self.frame_count += len(frames["seq"])
        if sum(map(count_bins, self._pending)) >= max(_MIN_MERGED_FRAMES, self.frames_in_bin):
            self._merge_full_bins()

    def truncate_to_full_bins_and_forget_seq(self, max_frames: int) -> int:
        """Drop all but the first frames: those of full bins, at most `max_frames`.

        Returns:
            The number of frames left. The last frame has to be added again before the next one.
        """
        bins = concatenate_bins(self._bins) if self._bins else None
        ends = np.cumsum(bins["frames"] if bins is not None else [], dtype=np.int64)
        count = int(np.searchsorted(ends, max_frames, side="right"))
        self._bins = [_copy_rows(bins, 0, count)] if bins is not None and count else []
        self._pending, self._last_frame = [], None
        self.frame_count = int(ends[count - 1]) if count else 0
        return self.frame_count

    def get_bins(self) -> Bins | None:
        """Return all bins until now, the last one perhaps not full; None before the first frame."""
        pieces = self._get_pieces()
        return concatenate_bins(pieces) if pieces else None

    def pop_levels(self) -> list[Bins]:
        """Return the levels of all bins, the finest first; the builder is not used after this."""
        pieces = self._get_pieces()
        self._bins, self._pending = [], []
        if not pieces:
            return []
        # Columns are released one by one, to save memory.
        names = list(pieces[0])
        return build_levels(
            {name: np.concatenate([piece.pop(name) for piece in pieces]) for name in names}
        )

    def _get_pieces(self) -> list[Bins]:
        if not self._pending:
            return [*self._bins]
        rest = merge_bins_within_parts(concatenate_bins(self._pending), self.frames_in_bin)
        return [*self._bins, rest]

    def _merge_full_bins(self) -> None:
        """Merge pending frames, except those of a bin that is not full yet."""
        frames = concatenate_bins(self._pending)
        starts, end = _find_group_starts(frames["part"], self.frames_in_bin), count_bins(frames)
        full = end if end - starts[-1] == self.frames_in_bin else int(starts[-1])
        self._pending = [_copy_rows(frames, full, end)] if full < end else []
        if full:
            whole = {name: values[:full] for name, values in frames.items()}
            is_single = self.frames_in_bin == 1
            self._bins.append(whole if is_single else _merge_groups(whole, starts[starts < full]))
        if self._max_bins is not None and sum(map(count_bins, self._bins)) > self._max_bins:
            self._bins = [
                merge_bins_within_parts(concatenate_bins(self._bins), BINS_PER_COARSER_BIN)
            ]
            self.frames_in_bin *= BINS_PER_COARSER_BIN


def _frame_at(frames: Mapping[str, Array], row: int) -> tuple[int, int]:
    """Return part and number of a frame."""
    return int(frames["part"][row]) if "part" in frames else 0, int(frames["seq"][row])


def choose_frames_in_bin(frame_count: int, min_bins: int) -> int:
    """Return the most frames per bin, 1 or a power of 4, with which there are enough bins."""
    size = 1
    while frame_count // (size * BINS_PER_COARSER_BIN) >= max(min_bins, 1):
        size *= BINS_PER_COARSER_BIN
    return size


def select_bins(bins: Bins, begin_ns: int | None, end_ns: int | None) -> Bins:
    """Return the bins with frames in a time range; None: no bound."""
    rows = np.ones(count_bins(bins), dtype=np.bool_)
    if begin_ns is not None:
        rows &= bins["t_last_ns"] >= begin_ns
    if end_ns is not None:
        rows &= bins["t_first_ns"] < end_ns
    return {name: values[rows] for name, values in bins.items()}


def select_and_downsample_bins(
    bins: Bins, begin_ns: int | None, end_ns: int | None, max_bins: int
) -> MergedBins:
    """Return a time range's bins, merged to about `max_bins`."""
    found, count = select_bins(bins, begin_ns, end_ns), 1
    while count_bins(found) > max_bins:
        found = merge_bins_within_parts(found, BINS_PER_COARSER_BIN)
        count *= BINS_PER_COARSER_BIN
        if count > count_bins(bins):  # parts of a bin each
            break
    return MergedBins(found, count)


def _copy_rows(bins: Bins, begin: int, end: int) -> Bins:
    return {name: values[begin:end].copy() for name, values in bins.items()}


def count_bins(bins: Bins) -> int:
    """Return the number of bins."""
    return len(bins["part"])
