"""A session, or a slice of it, as a stream of bytes in another format: memory stays bounded.

Columns are the flat ones of a sealed file, whatever the format. What an emulated or a measured
session has is what is given; nothing is resampled.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Literal, get_args

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as pacsv
import pyarrow.parquet as pq

from devices.errors import UsageError
from devices.frames import ArrayInfo, FrameBatch
from storage.clock.table import ClockTable
from storage.formats.marks import Marks
from storage.formats.slice import Slice
from storage.schema import (
    ARRAY_INFO_KEY,
    FRAMES,
    KNOWN,
    MARKS,
    SERVER_TIME,
    Array,
    flat_columns,
)
from storage.sessions.file import EXPORT_KEY, NOTES_KEY, parquet_options

Format = Literal["parquet", "arrow", "csv"]
FORMATS: tuple[Format, ...] = get_args(Format)

ClockName = Literal["node", "server"]
CLOCKS: tuple[ClockName, ...] = get_args(ClockName)
"""Whose time goes with the frames: the node's own only, or the server's beside it."""

MEDIA_TYPES: Mapping[Format, str] = {
    "parquet": "application/vnd.apache.parquet",
    "arrow": "application/vnd.apache.arrow.stream",
    "csv": "text/csv; charset=utf-8; header=present",
}

_MADE = {column.name: "Ask for the clock `server` as well" for column in SERVER_TIME}
_MADE |= {column.name: "Ask for marks as well" for column in MARKS}

Pieces = Iterable[tuple[FrameBatch, Mapping[str, Array]]]


def export(
    pieces: Pieces,
    info: ArrayInfo,
    notes: Mapping[str, object],
    to: Format,
    part: Slice,
    clock: ClockTable | None = None,
    marks: Marks | None = None,
    source: Mapping[str, object] | None = None,
) -> Iterator[bytes]:
    """A session's frames as bytes of a file.

    Args:
        pieces: frames with their further columns, in order.
        info: the array.
        notes: for the file's metadata; CSV has no place for them.
        to: format.
        part: rows and columns.
        clock: adds `t_server_ns` and its bound, and how they were found to the notes; None: not.
        marks: adds `event`, and what became of each mark to the notes; None: not.
        source: which session it is of, and its hashes; for the metadata.

    Yields:
        Chunks of the file. There is a header even if no frame is in the slice, as in a gap.

    Raises:
        UsageError: a column is not there, or the slice begins after the session's end; raised
            before the first chunk.
    """
    if clock is not None:
        pieces = _with_server_time(pieces, clock)
        notes = {**notes, "clock": clock.summary().model_dump(mode="json")}
    if marks is not None:
        pieces = marks.added(pieces)
        notes = {**notes, "marks": [mark.as_dict() for mark in marks.all]}
    chosen = {"start_s": part.start_s, "end_s": part.end_s, "columns": list(part.columns)}
    made_of = {**(source or {}), **chosen, "clock": "node" if clock is None else "server"}
    metadata: dict[bytes | str, bytes | str] = {
        ARRAY_INFO_KEY: info.model_dump_json().encode(),
        NOTES_KEY: json.dumps(notes, sort_keys=True).encode(),
        EXPORT_KEY: json.dumps(made_of).encode(),
    }
    tables = _tables(pieces, info, metadata, part)
    first = next(tables, None)
    if first is None:
        raise UsageError("the session has no frames")
    sink = _Sink()
    writer = _open(sink, first.schema, to)
    writer.write_table(first)
    yield sink.taken()
    for table in tables:
        writer.write_table(table)
        yield sink.taken()
    writer.close()
    yield sink.taken()


def _tables(
    pieces: Pieces, info: ArrayInfo, metadata: dict[bytes | str, bytes | str], part: Slice
) -> Iterator[pa.Table]:
    begin_t_ns: int | None = None
    end_t_ns = 0
    header: pa.Table | None = None
    for frames, extra in pieces:
        if not len(frames):
            continue
        if begin_t_ns is None:
            begin_t_ns = end_t_ns = int(frames.t_ns[0])
        end_t_ns = max(end_t_ns, int(frames.t_ns.max()))
        values = {column.name: getattr(frames, column.name) for column in FRAMES} | dict(extra)
        rows = part.rows(frames.t_ns, begin_t_ns)
        wanted = _chosen(tuple(values), len(info.tiles), part.columns)
        logical = dict.fromkeys(name for name, _ in wanted)
        flat = {
            field.name: (field, array)
            for field, array in flat_columns(
                [KNOWN[name] for name in logical], {name: values[name][rows] for name in logical}
            )
        }
        chosen = [flat[name] for _, name in wanted]
        table = pa.Table.from_arrays(
            [array for _, array in chosen],
            schema=pa.schema([field for field, _ in chosen], metadata=metadata),
        )
        if len(table):
            yield table
            header = table
        elif header is None:
            header = table
    if header is None or len(header):
        return
    end_s = (end_t_ns - (begin_t_ns or 0)) * 1e-9
    if part.begins_after(end_s):
        raise UsageError(
            f"the slice starts at {part.start_s:g} s, and the session ends at {end_s:.3f} s",
            expected="a start before the session's end",
        )
    yield header


def _with_server_time(
    pieces: Pieces, clock: ClockTable
) -> Iterator[tuple[FrameBatch, Mapping[str, Array]]]:
    for frames, extra in pieces:
        yield frames, {**extra, **clock.columns(frames.t_mono_ns, frames.t_ns, extra.get("part"))}


def _chosen(present: Sequence[str], tiles: int, asked: Sequence[str]) -> list[tuple[str, str]]:
    """Logical and flat name of every column asked for, in that order, each once."""
    flat = {f: name for name in present for f in KNOWN[name].flat_names(tiles)}
    if not asked:
        return [(name, f) for f, name in flat.items()]
    chosen: dict[str, str] = {}
    for name in asked:
        if name in present:
            chosen |= dict.fromkeys(KNOWN[name].flat_names(tiles), name)
        elif name in flat:
            chosen[name] = flat[name]
        else:
            raise UsageError(
                f"no column {name[:80]!r} in this session",
                expected=f"some of {', '.join(present)}",
                remedy=_MADE.get(name, ""),
            )
    return [(name, f) for f, name in chosen.items()]


class _Sink(io.BytesIO):
    """A file that is handed on in pieces."""

    def __init__(self) -> None:
        super().__init__()
        self._given = 0

    def tell(self) -> int:
        """Position in the whole file, of which only the end is kept here."""
        return self._given + super().tell()

    def taken(self) -> bytes:
        """What was written since."""
        piece = self.getvalue()
        self._given += len(piece)
        self.seek(0)
        self.truncate()
        return piece


def _open(sink: _Sink, schema: pa.Schema, to: Format) -> Any:
    match to:
        case "parquet":
            return pq.ParquetWriter(sink, schema, **parquet_options(schema))
        case "arrow":
            return pa.ipc.new_stream(sink, schema)
        case "csv":
            return _CsvWriter(sink, schema)


_FORMULA = r"^([=+\-@'\t\r\n\x{ff0b}\x{ff0d}\x{ff1d}\x{ff20}])"
"""What a spreadsheet takes for the beginning of a formula, and the sign that says it is none."""


class _CsvWriter(pacsv.CSVWriter):
    """Text that begins like a formula gets an apostrophe before it, and so does one with one."""

    def write_table(self, table: pa.Table, max_chunksize: int | None = None) -> None:
        """Append rows."""
        for i, field in enumerate(table.schema):
            if pa.types.is_string(field.type):
                text = pc.replace_substring_regex(table.column(i), _FORMULA, r"'\1")
                table = table.set_column(i, field, text)
        super().write_table(table, max_chunksize)
