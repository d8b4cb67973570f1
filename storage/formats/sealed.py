"""Export of a sealed file with its sidecars: frames, the server's time, markers."""

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
"""Search distance with a margin: float64 sums of instants do not wrap, but are off by 2 us."""


def marks_of(reader: SessionReader, events: Sequence[Event], part: Slice) -> Marks:
    """Place markers at frames of a sealed file; at none if its clock table is missing or damaged.

    Raises:
        FileFormatError: the file is damaged.
    """
    if not events:
        return Marks(())
    try:
        clock = clock_beside(reader)
    except (UsageError, FileFormatError) as error:  # export the frames without markers
        return Marks([Mark(event, left_out=error.what) for event in events])
    names = (*TIMES, "part") if reader.has("part") else TIMES
    pieces = reader.columns(*names, groups=_near(reader, clock, events))
    return place(events, pieces, clock, part, reader.span_ns()[0], reader.axis)


def _near(reader: SessionReader, clock: ClockTable, events: Sequence[Event]) -> list[int]:
    """Return the row groups that may have a marker's frame, by the times in the footer.

    At least one row group with a compared clock is included, if there is one: a marker without a
    frame is reported differently if no frame has the server's time.
    """
    names = (*TIMES[1:], "part") if reader.has("part") else TIMES[1:]
    extremes = zip(*(reader.extremes(name) for name in names), strict=True)
    near: set[int] = set()
    compared: list[int] = []
    by_part: dict[int, list[tuple[int, ...]]] = {}
    for group, (t_mono_ns, t_ns, *part) in enumerate(extremes):
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
        compared += groups.tolist()
        least, greatest, sure = reach
        first = np.searchsorted(marks_ns, earliest.astype(np.float64) + least - _NEAR_NS)
        behind = np.searchsorted(marks_ns, latest.astype(np.float64) + greatest + _NEAR_NS)
        near.update(groups[~sure | (first < behind)].tolist())
    if near.isdisjoint(compared):
        near.update(sorted(compared)[:1])
    return sorted(near)


def export_of(
    reader: SessionReader,
    part: Slice,
    *,
    clock: ClockName = "node",
    marks: Marks | None = None,
    options: FormatOptions = NO_OPTIONS,
) -> Export:
    """Return the export of a sealed file, which reads only the data that the slice needs.

    Raises:
        UsageError: the server's time is requested, and the clock table is missing.
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
