"""The overview of a sealed session: gathered while frames are written, or made again from the file.

Asked for some time and so many points it answers with bins, the coarsest level that has as many;
and where that is finer than any level, with bins of the frames themselves.
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
"""Numbers of frames that are read at once for a zoom, of which little is left: 2 MiB."""
_NOT_WRITTEN = f"{OVERVIEW_NAME} was not written, and is made again when it is asked for"


class OverviewBeside:
    """Gathers the overview of frames that are being sealed, and writes it beside these.

    Whatever goes wrong with that holds no session up: it is said, and it is made again later.

    Attributes:
        problem: why it is not there; None: it is.
    """

    def __init__(self, tiles: int) -> None:
        self.problem: str | None = None
        self._tiles = tiles
        self._pyramid = Pyramid()

    def feed(self, frames: FrameBatch, columns: Mapping[str, Array]) -> None:
        """Take the next frames with their columns."""
        if self.problem is not None:
            return
        try:
            wanted = frame_columns(estimated="grf_n" in columns)
            known = {name: columns[name] for name in (*wanted, "part") if name in columns}
            own = {name: getattr(frames, name) for name in wanted if name not in known}
            self._pyramid.feed(known | own)
        except Exception as error:  # a session is worth more than what can be made from it again
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
    """Some time of a session as bins.

    Attributes:
        bins: of `storage.sessions.pyramid`, in the order of the file, instants on the time axis.
        frames_in_bin: how many frames a bin stands for: 1, these are the frames themselves.
        begin_ns: `t_ns` of the session's first frame.
        end_ns: last instant on the axis.
        axis: the session's time axis.
    """

    bins: Bins
    frames_in_bin: int
    begin_ns: int
    end_ns: int
    axis: TimeAxis


def overview_of_session(
    session: SessionReader, part: Slice, points: int, *, frames_sha256: str
) -> Seen:
    """Some time of a sealed session, as `points` bins at least and four times as many at most.

    There are fewer where there are fewer frames. An overview that is missing, damaged or of other
    frames is made again, and kept if the folder can be written to.

    Args:
        session: its frames, open for slices.
        part: which time; its columns do not count.
        points: how many bins.
        frames_sha256: file hash of its frames.

    Raises:
        FileFormatError: the frames are damaged.
    """
    path = session.path.with_name(OVERVIEW_NAME)
    begin_ns, end_ns = session.span_ns()
    bounds = part.bounds_ns(begin_ns)
    try:
        with open_overview(path) as kept:
            found = _of_levels(kept, frames_sha256, bounds, points, session.axis)
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
    """Bins of the coarsest level that has enough, and of how many frames each is.

    If none has: about how many frames there are.

    Raises:
        DamagedFileError: a piece is damaged, or the overview is of other frames.
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
    """Bins of the frames themselves: of 16 or 4 frames, or each of one."""
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
        of = int(frames["part"][0]) if "part" in frames else 0
        before = last[1] if last is not None and last[0] == of else None
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
    """A new one, kept beside the frames if their folder can be written to."""
    levels, tiles = _pyramid_of(session).levels(), len(session.info.tiles)
    try:
        write_overview(path, levels, tiles=tiles, frames_sha256=frames_sha256)
        return open_overview(path)
    except (FileNotFoundError, FileFormatError, StorageError):
        content = overview_content(levels, tiles=tiles, frames_sha256=frames_sha256)
        return Overview(pa.BufferReader(content), where=str(path))
