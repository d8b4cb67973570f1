"""Overview of a sealed session at any zoom: built while frames are written, or rebuilt later.

For a slice and a number of points it returns bins of the coarsest level with enough bins; beyond
the finest level, bins of the frames themselves.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa

from devices.errors import DamagedFileError, FileFormatError, FootTileError, StorageError
from devices.frames import FrameBatch
from storage.formats.slice import Slice
from storage.schema import Array
from storage.sessions.overview import (
    OVERVIEW_NAME,
    Overview,
    open_overview,
    overview_content,
    write_overview,
)
from storage.sessions.pyramid import (
    FACTOR,
    ROWS,
    Bins,
    Pyramid,
    bin_columns,
    bins_of_frames,
    frame_columns,
    joined,
    merged,
    on_axis,
)
from storage.sessions.reader import SessionReader
from storage.sessions.time_axis import TimeAxis

log = logging.getLogger("foottile.overview")

POINTS_MAX = 8000
_VALUES_MAX = 1 << 18
"""Values read at once for a zoom into frames: 2 MiB."""
_NOT_WRITTEN = f"{OVERVIEW_NAME} was not written, and is rebuilt on request"


class OverviewBeside:
    """Builder of the overview of frames that are being sealed.

    A failure does not affect the session: it is reported, and the overview is rebuilt later.

    Attributes:
        problem: reason why it is missing; None: it is written.
    """

    def __init__(self, tiles: int) -> None:
        self.problem: str | None = None
        self._tiles = tiles
        self._pyramid = Pyramid()

    def feed(self, frames: FrameBatch, columns: Mapping[str, Array]) -> None:
        """Add the next frames with their columns."""
        if self.problem is not None:
            return
        try:
            wanted = frame_columns(estimated="grf_n" in columns)
            given_columns = {name: columns[name] for name in (*wanted, "part") if name in columns}
            frame_fields = {
                name: getattr(frames, name) for name in wanted if name not in given_columns
            }
            self._pyramid.feed(given_columns | frame_fields)
        except Exception as error:  # never fail a session for a derived file
            log.exception("overview: this is a bug")
            self.problem = f"{_NOT_WRITTEN}: {error}"

    def write(self, folder: Path, frames_sha256: str) -> None:
        """Write `overview.arrow`."""
        if self.problem is not None:
            return
        try:
            levels = self._pyramid.levels()
            path = folder / OVERVIEW_NAME
            write_overview(path, levels, tiles=self._tiles, frames_sha256=frames_sha256)
        except Exception as error:
            if not isinstance(error, FootTileError):
                log.exception("overview: this is a bug")
            self.problem = f"{_NOT_WRITTEN}: {error}"


@dataclass(frozen=True)
class Seen:
    """Slice of a session as bins.

    Attributes:
        bins: bins as in `storage.sessions.pyramid`, in the order of the file, times on the time
            axis.
        frames_in_bin: number of frames per bin; 1: these are the frames themselves.
        begin_ns: `t_ns` of the session's first frame.
        end_ns: last time on the axis.
        axis: time axis of the session.
    """

    bins: Bins
    frames_in_bin: int
    """number of frames per bin; 1: these are the frames themselves."""
    begin_ns: int
    end_ns: int
    axis: TimeAxis
    """time axis of the session."""


def overview_of_session(
    session: SessionReader, part: Slice, points: int, *, frames_sha256: str
) -> Seen:
    """Return a slice of a sealed session as `points` to four times as many bins.

    Fewer only where there are fewer frames. A missing, damaged or outdated overview is rebuilt, and
    stored if the folder is writable.

    Args:
        session: frames of the session, open for slices.
        part: time interval; its columns are ignored.
        points: least number of bins.
        frames_sha256: hash of the file of frames.

    Raises:
        FileFormatError: the frames are damaged.
    """
    path = session.path.with_name(OVERVIEW_NAME)
    begin_ns, end_ns = session.span_ns()
    bounds = part.bounds_ns(begin_ns)
    try:
        with open_overview(path) as stored:
            found = _of_levels(stored, frames_sha256, bounds, points, session.axis)
    except (FileNotFoundError, FileFormatError, StorageError):
        with _made(path, session, frames_sha256) as made:
            found = _of_levels(made, frames_sha256, bounds, points, session.axis)
    if isinstance(found, int):
        found = _of_frames(session, part, begin_ns, points, found)
    bins, size = found
    return Seen(bins, size, begin_ns, end_ns, session.axis)


def _of_levels(
    overview: Overview,
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
    for level in reversed(range(overview.index.levels)):
        if overview.count(level, *bounds, axis) >= points:
            bins = overview.bins(level, *bounds, axis)
            if len(bins["part"]) >= points:
                return bins, ROWS * FACTOR**level
    return ROWS * len(overview.bins(0, *bounds, axis)["part"])


def _of_frames(
    session: SessionReader, part: Slice, begin_ns: int, points: int, rows: int
) -> tuple[Bins, int]:
    """Return bins of 16, 4 or 1 frames, and the frames per bin."""
    size = 1
    while rows // (size * FACTOR) >= points:
        size *= FACTOR
    estimated = session.has("grf_n")
    names = frame_columns(estimated=estimated)
    if session.has("part"):
        names += ("part",)
    types = bin_columns(len(session.info.tiles), estimated=estimated)
    found: list[Bins] = [{name: np.empty(0, type_) for name, type_ in types.items()}]
    last: tuple[int, int] | None = None
    groups = session.groups_within(*part.bounds_ns(begin_ns))
    for piece in session.columns(*names, groups=groups, values_max=_VALUES_MAX):
        inside = part.rows(session.axis.at(piece["t_ns"], piece.get("part")), begin_ns)
        frames = {name: values[inside] for name, values in piece.items()}
        if not len(frames["seq"]):
            continue
        first_part = int(frames["part"][0]) if "part" in frames else 0
        before = last[1] if last is not None and last[0] == first_part else None
        found.append(bins_of_frames(frames, before))
        last = int(frames["part"][-1]) if "part" in frames else 0, int(frames["seq"][-1])
    bins = on_axis(joined([{name: piece[name] for name in types} for piece in found]), session.axis)
    return (bins if size == 1 else merged(bins, size)), size


def _pyramid_of(session: SessionReader) -> Pyramid:
    pyramid = Pyramid()
    names = frame_columns(estimated=session.has("grf_n"))
    for piece in session.columns(*names, *(("part",) if session.has("part") else ())):
        pyramid.feed(piece)
    return pyramid


def _made(path: Path, session: SessionReader, frames_sha256: str) -> Overview:
    """Rebuild the overview, and store it if the folder is writable."""
    levels, tiles = _pyramid_of(session).levels(), len(session.info.tiles)
    try:
        write_overview(path, levels, tiles=tiles, frames_sha256=frames_sha256)
        return open_overview(path)
    except (FileNotFoundError, FileFormatError, StorageError):
        content = overview_content(levels, tiles=tiles, frames_sha256=frames_sha256)
        return Overview(pa.BufferReader(content), where=str(path))
