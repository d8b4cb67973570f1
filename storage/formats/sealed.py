"""A sealed file with what lies beside it, exported: its frames, the server's time, the marks."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from devices.errors import FileFormatError, UsageError
from devices.frames import FRAME_COLUMNS
from storage.formats.export import ClockName, Format, export
from storage.formats.marks import TIMES, Mark, Marks, place
from storage.formats.slice import Slice
from storage.schema import KNOWN
from storage.sessions.beside import clock_beside
from storage.sessions.file import SessionReader
from storage.sessions.folder import Event


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
    return place(events, reader.columns(*names), clock, part)


def export_file(
    reader: SessionReader, to: Format, part: Slice, *, clock: ClockName, marks: Marks | None
) -> Iterator[bytes]:
    """A sealed file as bytes of another one, as `export` does it.

    Raises:
        UsageError: as for `export`; the server's time is asked for, and no clock table is there.
        FileFormatError: the file or its clock table is damaged.
    """
    extra = [name for name in KNOWN if name not in FRAME_COLUMNS and reader.has(name)]
    table = clock_beside(reader) if clock == "server" else None
    yield from export(
        reader.batches(*extra),
        reader.info,
        reader.notes,
        to,
        part,
        table,
        marks,
        source=reader.identity,
    )
