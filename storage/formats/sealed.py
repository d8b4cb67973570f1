"""A sealed file with what lies beside it, exported: its frames, the server's time, the marks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from devices.errors import FileFormatError, UsageError
from devices.frames import FRAME_COLUMNS
from storage.clock.table import ClockTable
from storage.formats.export import ClockName, Content, Export
from storage.formats.marks import NEAREST_NS, TIMES, Mark, Marks, place
from storage.formats.options import NO_OPTIONS, FormatOptions
from storage.formats.slice import Slice
from storage.schema import FRAMES, KNOWN
from storage.sessions.beside import clock_beside
from storage.sessions.folder import Event
from storage.sessions.reader import SessionReader

_NEAR_NS = NEAREST_NS + 1_000_000
"""Rather a group too many; sums of instants as float64, which do not wrap, are off by 2 us."""


def marks_of(reader: SessionReader, events: Sequence[Event], part: Slice) -> Marks:
    """Where events stand in a sealed file; at no frame if no sound clock table lies beside it.

    Raises:
        FileFormatError: the file is damaged.
    """
    if not events:
        return Marks(())
    try:
        clock = clock_beside(reader)
    except (UsageError, FileFormatError) as error:  # the frames are worth more than the marks
        return Marks([Mark(event, left_out=error.what) for event in events])
    names = (*TIMES, "part") if reader.has("part") else TIMES
    pieces = reader.columns(*names, groups=_near(reader, clock, events))
    return place(events, pieces, clock, part, reader.span_ns()[0], reader.axis)


def _near(reader: SessionReader, clock: ClockTable, events: Sequence[Event]) -> list[int]:
    """Row groups in which a mark may stand, by what the footer says of their times.

    If none of them is one whose clock was compared, such a one as well: who finds no frame near a
    mark has to know whether any frame's time is known.
    """
    names = (*TIMES[1:], "part") if reader.has("part") else TIMES[1:]
    said = zip(*(reader.extremes(name) for name in names), strict=True)
    near: set[int] = set()
    known: list[int] = []
    by_part: dict[int, list[tuple[int, ...]]] = {}
    for group, (t_mono_ns, t_ns, *part) in enumerate(said):
        of_part = part[0] if part else (0, 0)
        if t_mono_ns is None or t_ns is None or of_part is None or of_part[0] != of_part[1]:
            near.add(group)
        else:
            by_part.setdefault(of_part[0], []).append((group, *t_mono_ns, *t_ns))
    marks_ns = np.sort(np.array([event.t_ns for event in events], dtype=np.float64))
    for number, rows in by_part.items():
        groups, begins, ends, earliest, latest = np.array(rows, dtype=np.int64).T
        reach = clock.reach(begins, ends, number)
        if reach is None:
            continue
        known += groups.tolist()
        least, greatest, sure = reach
        first = np.searchsorted(marks_ns, earliest.astype(np.float64) + least - _NEAR_NS)
        behind = np.searchsorted(marks_ns, latest.astype(np.float64) + greatest + _NEAR_NS)
        near.update(groups[~sure | (first < behind)].tolist())
    if near.isdisjoint(known):
        near.update(sorted(known)[:1])
    return sorted(near)


def export_of(
    reader: SessionReader,
    part: Slice,
    *,
    clock: ClockName = "node",
    marks: Marks | None = None,
    options: FormatOptions = NO_OPTIONS,
) -> Export:
    """A sealed file as formats are given it: what the slice needs of it is read, and no more.

    Raises:
        UsageError: the server's time is asked for, and no clock table is there.
        FileFormatError: the file or its clock table is damaged.
    """
    extra = [name for name in KNOWN if name not in FRAME_COLUMNS and reader.has(name)]
    table = clock_beside(reader) if clock == "server" else None
    begin_t_ns, end_t_ns = reader.span_ns()
    bounds_ns = part.bounds_ns(begin_t_ns)
    names = [*(column.name for column in FRAMES), *extra]
    return Export(
        Content(
            names, lambda flat: reader.flat(flat, *bounds_ns), begin_t_ns, end_t_ns, reader.axis
        ),
        reader.info,
        reader.notes,
        part,
        table,
        marks,
        reader.identity,
        options,
    )
