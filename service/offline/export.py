"""Export of sealed sessions to other file formats, with their markers."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from devices.errors import UsageError
from storage.durable_files import open_for_atomic_write
from storage.formats.export import (
    ClockName,
    Export,
    compute_take_offsets_s,
    make_sealed_export,
)
from storage.formats.markers import PlacedMarker, place_session_markers
from storage.formats.slice import NO_OPTIONS, FormatOptions, Slice
from storage.formats.writers.registry import get_format, get_multi_session_format
from storage.sessions.metadata import MARKERS_NAME, read_existing_markers
from storage.sessions.reader import SealedFileReader

_ALL = Slice()


@dataclass(frozen=True)
class ExportOptions:
    """Options of an export; see `foottile export --help`."""

    to: str
    """Name of the format."""
    part: Slice = _ALL
    clock: ClockName = "node"
    markers: bool | None = None
    """Export of markers; None: if there is a markers file beside the frames."""
    options: FormatOptions = NO_OPTIONS


@dataclass(frozen=True)
class ExportResult:
    """Result of an export."""

    size_bytes: int
    left_out_markers: tuple[PlacedMarker, ...]
    """Markers without a frame."""
    is_markers_file_missing: bool
    """True if a markers file was expected beside the frames but is missing."""
    remarks: tuple[str, ...]
    """Remarks for the user on time axes and filled gaps."""


def export_session(source: Path, out: Path, options: ExportOptions) -> ExportResult:
    """Write a sealed session, or a slice, in another format.

    Args:
        source: the session's frames file.
        out: the file to write.
        options: options of the export.

    Raises:
        UsageError: requested markers or clock do not exist, or a slice is empty.
        FileFormatError: a file is damaged.
        StorageError: `out` cannot be written.
    """
    to = get_format(options.to)
    with SealedFileReader(source, only_slices=not options.part.has_all_rows_and_columns) as reader:
        export, lacks_marks = _prepare_export(reader, options)
        return _write_export(out, to.encode(export), [export], lacks_marks)


def export_merged(sources: Sequence[Path], out: Path, options: ExportOptions) -> ExportResult:
    """Write several sealed sessions to one file, on the server's time axis.

    Args:
        sources: the sessions' frames files.
        out: the file to write.
        options: options of the export; a slice counts from the first frame of all sessions.

    Raises:
        UsageError: as for `export_session`; or the format supports one session only.
        FileFormatError: a file is damaged.
        StorageError: `out` cannot be written.
    """
    to = get_multi_session_format(options.to)
    with ExitStack() as opened:
        readers = [
            opened.enter_context(
                SealedFileReader(source, only_slices=not options.part.has_all_rows_and_columns)
            )
            for source in sources
        ]
        found = [
            _prepare_export(reader, options, offset_s)
            for reader, offset_s in zip(readers, compute_take_offsets_s(readers), strict=True)
        ]
        exports = [export for export, _ in found]
        lacks_marks = any(lacks for _, lacks in found)
        return _write_export(out, to.encode_together_on_server_clock(exports), exports, lacks_marks)


def _prepare_export(
    reader: SealedFileReader, options: ExportOptions, take_offset_s: float = 0.0
) -> tuple[Export, bool]:
    """Prepare an export; also return True if an expected markers file is missing."""
    beside = reader.path.with_name(MARKERS_NAME)
    stored = (
        read_existing_markers(beside) if options.markers is not False and beside.is_file() else None
    )
    if options.markers and stored is None:
        raise UsageError(
            f"there is no {MARKERS_NAME} beside {reader.path.name}, so its markers are unknown",
            where=str(reader.path.parent),
            expected="a session's folder as a server sealed it or `foottile pull` fetched it",
        )
    placed = (
        None
        if stored is None
        else place_session_markers(reader, stored, options.part, take_offset_s)
    )
    export = make_sealed_export(
        reader,
        options.part,
        clock=options.clock,
        markers=placed,
        options=options.options,
        take_offset_s=take_offset_s,
    )
    return export, options.markers is None and stored is None and "session" in reader.notes


def _write_export(
    out: Path, chunks: Iterator[bytes], exports: Sequence[Export], lacks_marks: bool
) -> ExportResult:
    with open_for_atomic_write(out) as file:
        for chunk in chunks:
            file.write(chunk)
    left_out = [
        marker for export in exports if export.markers for marker in export.markers.excluded
    ]
    remarks = [
        f"{export.session_and_node_text}: {remark}"
        for export in exports
        if (remark := export.frame_source.axis.explain_shift_or_empty())
    ]
    remarks += [remark for export in exports for remark in export.remarks]
    return ExportResult(out.stat().st_size, tuple(left_out), lacks_marks, tuple(remarks))
