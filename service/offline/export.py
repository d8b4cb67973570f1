"""Export of sealed sessions to other file formats, with their markers."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from devices.errors import UsageError
from storage.durable import whole_file
from storage.formats.export import ClockName, Export
from storage.formats.marks import Mark
from storage.formats.options import NO_OPTIONS, FormatOptions
from storage.formats.sealed import export_of, marks_of
from storage.formats.slice import Slice
from storage.formats.written.registry import format_named, together_named
from storage.sessions.beside import EVENTS_NAME, read_events
from storage.sessions.reader import SessionReader

_ALL = Slice()


@dataclass(frozen=True)
class ExportOptions:
    """Options of an export; see `foottile export --help`."""

    to: str
    """Name of the format."""
    part: Slice = _ALL
    clock: ClockName = "node"
    marks: bool | None = None
    """Export of markers; None: if there is a markers file beside the frames."""
    options: FormatOptions = NO_OPTIONS


@dataclass(frozen=True)
class Exported:
    """Result of an export."""

    size_bytes: int
    left_out: tuple[Mark, ...]
    """Markers without a frame."""
    lacks_marks: bool
    """True if a markers file was expected beside the frames but is missing."""
    remarks: tuple[str, ...]
    """Remarks on the time axes for the user."""


def export_session(source: Path, out: Path, options: ExportOptions) -> Exported:
    """Write a sealed session, or a slice of it, in another format.

    Args:
        source: the session's frames file.
        out: the file to write.
        options: options of the export.

    Raises:
        UsageError: requested markers or clock do not exist, or a slice is empty.
        FileFormatError: a file is damaged.
        StorageError: `out` cannot be written.
    """
    to = format_named(options.to)
    with SessionReader(source, only_slices=not options.part.is_all) as reader:
        export, lacks_marks = _export_of(reader, options)
        return _written(out, to.written(export), [export], lacks_marks)


def export_together(sources: Sequence[Path], out: Path, options: ExportOptions) -> Exported:
    """Write several sealed sessions to one file, on the server's time axis.

    Args:
        sources: the sessions' frames files.
        out: the file to write.
        options: options of the export; a slice counts from each session's own first frame.

    Raises:
        UsageError: as for `export_session`; or the format supports one session only.
        FileFormatError: a file is damaged.
        StorageError: `out` cannot be written.
    """
    to = together_named(options.to)
    with ExitStack() as opened:
        readers = [
            opened.enter_context(SessionReader(source, only_slices=not options.part.is_all))
            for source in sources
        ]
        found = [_export_of(reader, options) for reader in readers]
        exports = [export for export, _ in found]
        lacks_marks = any(lacks for _, lacks in found)
        return _written(out, to.written_together(exports), exports, lacks_marks)


def _export_of(reader: SessionReader, options: ExportOptions) -> tuple[Export, bool]:
    """Prepare an export; also return True if an expected markers file is missing."""
    beside = reader.path.with_name(EVENTS_NAME)
    stored = read_events(beside) if options.marks is not False and beside.is_file() else None
    if options.marks and stored is None:
        raise UsageError(
            f"there is no {EVENTS_NAME} beside {reader.path.name}, so its markers are unknown",
            where=str(reader.path.parent),
            expected="a session's folder as a server sealed it or `foottile pull` fetched it",
        )
    placed = None if stored is None else marks_of(reader, stored.events, options.part)
    export = export_of(
        reader, options.part, clock=options.clock, marks=placed, options=options.options
    )
    return export, options.marks is None and stored is None and "session" in reader.notes


def _written(
    out: Path, chunks: Iterator[bytes], exports: Sequence[Export], lacks_marks: bool
) -> Exported:
    with whole_file(out) as file:
        for chunk in chunks:
            file.write(chunk)
    left_out = [mark for export in exports if export.marks for mark in export.marks.left_out]
    remarks = [
        f"{export.called}: {remark}"
        for export in exports
        if (remark := export.content.axis.remark())
    ]
    return Exported(out.stat().st_size, tuple(left_out), lacks_marks, tuple(remarks))
