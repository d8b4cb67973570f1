"""Frames at every zoom: bins with minimum and maximum of each column, so that no peak is lost.

A bin covers consecutive frames of one part of a session: single frames are bins as well. Bins are
merged to coarser ones, 64 frames at first and then four bins at a time. Minimum and maximum of a
merged bin are exactly those of its frames, in whatever order they were merged.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from devices.frames import NOT_READ
from storage.schema import CONTACT_UNKNOWN, Array
from storage.sessions.time_axis import TimeAxis

ROWS = 64
"""Frames of a bin of the finest stored level."""
FACTOR = 4
"""Bins of one level that are merged to one of the next."""
TOP = 512
"""Most bins of the coarsest level."""
INTERVAL_95 = 1.96

WITHOUT, WITH, UNKNOWN = 1, 2, 4
"""Bits of `contact`: some frames without contact, with contact, with unknown contact."""

Bins = dict[str, Array]
"""Columns of bins by name, n rows each."""

_SAME = (
    *("t_first_ns", "t_last_ns", "part", "frames", "missing", "frame_status"),
    *("grf_n_min", "grf_n_max", "grf_low_n_min", "grf_high_n_max", "grf_at_least_n_max"),
    *("grf_unknown", "cop_x_m_min", "cop_x_m_max", "cop_y_m_min", "cop_y_m_max"),
    *("cop_x_low_m_min", "cop_x_high_m_max", "cop_y_low_m_min", "cop_y_high_m_max"),
    *("angle_rad_min", "angle_rad_max", "contact", "estimate_status"),
)
"""Columns of every array; those of each tile follow."""
_ESTIMATED = ("force_n_{i}_min", "force_n_{i}_max")
_RAW = ("padc_{i}_min", "padc_{i}_max")
_BY_TILE = "status_{i}"
_COUNTED = frozenset({"frames", "missing", "grf_unknown"})
_BITS = frozenset({"frame_status", "contact", "estimate_status"})
_INTEGERS: Mapping[str, npt.DTypeLike] = {
    "t_first_ns": np.int64,
    "t_last_ns": np.int64,
    "part": np.uint16,
    "frames": np.uint32,
    "missing": np.uint64,
    "grf_unknown": np.uint32,
    "frame_status": np.uint8,
    "contact": np.uint8,
    "estimate_status": np.uint16,
}


def bin_columns(tiles: int, *, estimated: bool) -> dict[str, np.dtype[Any]]:
    """Return names and types of a bin's columns.

    `missing` counts frame numbers without a frame, in the bin or just before it. `grf_low_n_min`
    and `grf_high_n_max` bound the 95 % intervals of all its frames, those of `cop_x` and `cop_y` as
    well; `grf_unknown` counts frames without a GRF. Without estimates there are raw counts in place
    of forces, and otherwise only columns of frames.
    """
    names = [name for name in _SAME if estimated or not _is_estimate(name)]
    for i in range(tiles):
        names += [name.format(i=i) for name in (*(_ESTIMATED if estimated else _RAW), _BY_TILE)]
    return {name: np.dtype(_type_of(name)) for name in names}


def _is_estimate(name: str) -> bool:
    return name.startswith(("grf", "cop", "angle", "contact", "estimate"))


def _type_of(name: str) -> npt.DTypeLike:
    return np.uint8 if name.startswith("status_") else _INTEGERS.get(name, np.float32)


def frame_columns(*, estimated: bool) -> tuple[str, ...]:
    """Return the columns of frames that bins are made of, by logical name; `part` is optional."""
    same = ("seq", "t_ns", "status", "frame_status")
    if not estimated:
        return (*same, "padc")
    return (
        *same,
        *("grf_n", "grf_sigma_n", "grf_at_least_n", "angle_rad"),
        *("cop_x_m", "cop_y_m", "cop_sigma_x_m", "cop_sigma_y_m"),
        *("contact", "estimate_status", "force_n"),
    )


def bins_of_frames(frames: Mapping[str, Array], before: int | None = None) -> Bins:
    """Make a bin for each frame.

    Args:
        frames: `frame_columns`, (n,) or (n, tiles); `part` if there are several.
        before: number of the frame before the first one, if it is of the same part.
    """
    seq, n = frames["seq"], len(frames["seq"])
    part = frames["part"] if "part" in frames else np.zeros(n, np.uint16)
    missing = np.zeros(n, np.uint64)
    missing[1:] = np.where(part[1:] == part[:-1], seq[1:] - seq[:-1] - np.uint64(1), 0)
    if n and before is not None:
        missing[0] = seq[0] - np.uint64(before) - np.uint64(1)
    bins: Bins = {
        "t_first_ns": frames["t_ns"],
        "t_last_ns": frames["t_ns"],
        "part": part.astype(np.uint16),
        "frames": np.ones(n, np.uint32),
        "missing": missing,
        "frame_status": frames["frame_status"],
    }
    estimated = "grf_n" in frames
    if estimated:
        contact = frames["contact"]
        bins |= {
            "grf_at_least_n_max": frames["grf_at_least_n"].astype(np.float32),
            "grf_unknown": np.isnan(frames["grf_n"]).astype(np.uint32),
            "contact": np.select(
                [contact == CONTACT_UNKNOWN, contact == 0], [UNKNOWN, WITHOUT], WITH
            ).astype(np.uint8),
            "estimate_status": frames["estimate_status"],
        }
        for name in ("grf_n", "cop_x_m", "cop_y_m", "angle_rad"):
            bins |= _extremes(name, frames[name].astype(np.float32))
        bins |= _interval("grf_{}_n", frames["grf_n"], frames["grf_sigma_n"])
        for axis in ("x", "y"):
            place_m, sigma_m = frames[f"cop_{axis}_m"], frames[f"cop_sigma_{axis}_m"]
            bins |= _interval(f"cop_{axis}_{{}}_m", place_m, sigma_m)
    for i in range(frames["status"].shape[1]):
        bins[f"status_{i}"] = frames["status"][:, i]
        if estimated:
            bins |= _extremes(f"force_n_{i}", frames["force_n"][:, i].astype(np.float32))
        else:
            counts = frames["padc"][:, i].astype(np.float32)
            counts[frames["padc"][:, i] == NOT_READ] = np.nan
            bins |= _extremes(f"padc_{i}", counts)
    return bins


def _extremes(name: str, values: Array) -> Bins:
    return {f"{name}_min": values, f"{name}_max": values}


def _interval(name: str, values: Array, sigmas: Array) -> Bins:
    """Return the ends of 95 % intervals; `{}` in `name` becomes `low` and `high`."""
    middle = values.astype(np.float32)
    half = np.float32(INTERVAL_95) * sigmas.astype(np.float32)
    return {f"{name.format('low')}_min": middle - half, f"{name.format('high')}_max": middle + half}


def merged(bins: Bins, count: int) -> Bins:
    """Merge `count` bins at a time, or fewer at the end of a part."""
    if not len(bins["part"]):
        return bins
    return _joined_at(bins, starts_of(bins["part"], count))


def starts_of(part: Array, count: int) -> npt.NDArray[np.intp]:
    """Return the first index of each group of `count`; no group extends over two parts."""
    n = len(part)
    begins = np.flatnonzero(np.r_[True, part[1:] != part[:-1]])
    since = np.arange(n) - np.repeat(begins, np.diff(np.r_[begins, n]))
    return np.flatnonzero(since % count == 0)


def _joined_at(bins: Bins, starts: npt.NDArray[np.intp]) -> Bins:
    ends = np.r_[starts[1:], len(bins["part"])] - 1
    found: Bins = {}
    for name, values in bins.items():
        if name == "t_last_ns":
            found[name] = values[ends]
        elif name in {"t_first_ns", "part"}:
            found[name] = values[starts]
        elif name in _COUNTED:
            found[name] = np.add.reduceat(values, starts)
        elif name in _BITS or name.startswith("status_"):
            found[name] = np.bitwise_or.reduceat(values, starts)
        elif name.endswith("_min"):
            found[name] = np.fmin.reduceat(values, starts)
        else:
            found[name] = np.fmax.reduceat(values, starts)
    return found


def joined(pieces: list[Bins]) -> Bins:
    """Concatenate bins."""
    return {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}


def on_axis(bins: Bins, axis: TimeAxis) -> Bins:
    """Return bins with their instants on the session's time axis."""
    names = ("t_first_ns", "t_last_ns")
    return bins | {name: axis.at(bins[name], bins["part"]) for name in names}


class Pyramid:
    """Builder of a pyramid of bins from consecutive frames.

    The bins do not depend on how frames are cut into pieces.
    """

    def __init__(self) -> None:
        self._whole: list[Bins] = []
        self._begun: list[Bins] = []
        """Single frames of a bin that is not full yet."""
        self._before: tuple[int, int] | None = None
        """Part and number of the last frame."""

    def feed(self, frames: Mapping[str, Array]) -> None:
        """Add the next frames: `frame_columns`, and `part` if there are several."""
        if not len(frames["seq"]):
            return
        part = int(frames["part"][0]) if "part" in frames else 0
        follows = self._before is not None and self._before[0] == part
        before = self._before[1] if follows and self._before is not None else None
        last = int(frames["part"][-1]) if "part" in frames else 0
        self._before = last, int(frames["seq"][-1])
        self._begun.append(bins_of_frames(frames, before))
        if sum(len(piece["part"]) for piece in self._begun) >= ROWS:
            self._close_full()

    def finest(self) -> Bins | None:
        """Return all bins until now, the last one perhaps not full; None before the first frame."""
        rest = [merged(joined(self._begun), ROWS)] if self._begun else []
        pieces = [*self._whole, *rest]
        return joined(pieces) if pieces else None

    def levels(self) -> list[Bins]:
        """End the pyramid and return its levels, the finest first; the builder is empty then."""
        if self._begun:
            self._whole.append(merged(joined(self._begun), ROWS))
        pieces, self._whole, self._begun = self._whole, [], []
        return levels_over(_drained(pieces)) if pieces else []

    def _close_full(self) -> None:
        frames = joined(self._begun)
        starts, n = starts_of(frames["part"], ROWS), len(frames["part"])
        self._begun = []
        if n - starts[-1] < ROWS:
            last, starts = int(starts[-1]), starts[:-1]
            self._begun = [{name: values[last:].copy() for name, values in frames.items()}]
            frames = {name: values[:last] for name, values in frames.items()}
        if len(starts):
            self._whole.append(_joined_at(frames, starts))


def _drained(pieces: list[Bins]) -> Bins:
    """Concatenate bins; their columns are released one by one, to save memory."""
    return {name: np.concatenate([piece.pop(name) for piece in pieces]) for name in list(pieces[0])}


def levels_over(finest: Bins) -> list[Bins]:
    """Return a level and its coarser ones, until one has at most `TOP` bins."""
    levels = [finest]
    while len(levels[-1]["part"]) > TOP:
        levels.append(merged(levels[-1], FACTOR))
        if len(levels[-1]["part"]) == len(levels[-2]["part"]):  # parts of a bin each
            levels.pop()
            break
    return levels
