"""A session, or a slice of it, as a stream of bytes in another format: memory stays bounded.

Columns are the flat ones of a sealed file, whatever the format. What an emulated or a measured
session has is what is given; nothing is resampled.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any, BinaryIO, Literal, get_args

import numpy as np
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
    flat_column,
)
from storage.sessions.file import EXPORT_KEY, parquet_options
from storage.sessions.footer import NOTES_KEY

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
Flat = Mapping[str, Array]
"""Flat columns by name, n rows each."""


@dataclass(frozen=True)
class Content:
    """What a session has, to be exported.

    Attributes:
        names: its quantities, of `storage.schema.KNOWN`, in the order of their columns.
        read: gives these flat columns, and others if it likes, of frames in order.
        span_ns: `t_ns` of the session's first frame, and the latest; None: `read` gives the session
            from its first frame to its last, and not only where the slice is.
    """

    names: Sequence[str]
    read: Callable[[Sequence[str]], Iterable[Flat]]
    span_ns: tuple[int, int] | None = None


def content_of(pieces: Pieces) -> Content:
    """The content of a session of which all frames are given; the first of them are read.

    Args:
        pieces: frames with their further columns, in order.

    Raises:
        UsageError: there are no frames.
    """
    there = ((frames, extra) for frames, extra in pieces if len(frames))
    first = next(there, None)
    if first is None:
        raise UsageError("the session has no frames")
    names = [column.name for column in FRAMES] + list(first[1])
    flat = (_flat(frames, extra) for frames, extra in chain((first,), there))
    return Content(names, lambda _: flat)


def export(
    content: Content,
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
        content: the frames.
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
        notes = {**notes, "clock": clock.summary().model_dump(mode="json")}
    if marks is not None:
        notes = {**notes, "marks": [mark.as_dict() for mark in marks.all]}
    chosen = {"start_s": part.start_s, "end_s": part.end_s, "columns": list(part.columns)}
    made_of = {**(source or {}), **chosen, "clock": "node" if clock is None else "server"}
    metadata: dict[bytes | str, bytes | str] = {
        ARRAY_INFO_KEY: info.model_dump_json().encode(),
        NOTES_KEY: json.dumps(notes, sort_keys=True).encode(),
        EXPORT_KEY: json.dumps(made_of).encode(),
    }
    tables = _tables(content, len(info.tiles), metadata, notes, part, clock, marks)
    first = next(tables)
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
    content: Content,
    tiles: int,
    metadata: dict[bytes | str, bytes | str],
    notes: Mapping[str, object],
    part: Slice,
    clock: ClockTable | None,
    marks: Marks | None,
) -> Iterator[pa.Table]:
    made = [column.name for column in SERVER_TIME] if clock is not None else []
    made += [column.name for column in MARKS] if marks is not None else []
    chosen = _chosen([*content.names, *made], tiles, part.columns)
    begin_t_ns, end_t_ns = content.span_ns or (None, 0)
    header: pa.Table | None = None
    for flat in content.read(_needed(chosen, made, content.names)):
        t_ns = flat["t_ns"]
        if begin_t_ns is None:
            begin_t_ns = end_t_ns = int(t_ns[0])
        if content.span_ns is None:
            end_t_ns = max(end_t_ns, int(t_ns.max()))
        values = _of_rows(flat, part.rows(t_ns, begin_t_ns))
        if clock is not None:
            times = (values["t_mono_ns"], values["t_ns"], values.get("part"))
            values |= clock.columns(*times)
        if marks is not None:
            values["event"] = marks.column(values["seq"], values.get("part"))
        columns = [flat_column(KNOWN[of], name, values[name], notes) for name, of in chosen.items()]
        table = pa.Table.from_arrays(
            [array for _, array in columns],
            schema=pa.schema([field for field, _ in columns], metadata=metadata),
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


def _flat(frames: FrameBatch, extra: Mapping[str, Array]) -> dict[str, Array]:
    values = {column.name: getattr(frames, column.name) for column in FRAMES} | dict(extra)
    flat: dict[str, Array] = {}
    for name, value in values.items():
        parts = value.T if KNOWN[name].per_tile else value[None]
        flat |= zip(KNOWN[name].flat_names(len(parts)), parts, strict=True)
    return flat


def _of_rows(flat: Flat, rows: Array) -> dict[str, Array]:
    """These rows; where they are one piece, as in a slice of time they are, without a copy."""
    at = np.flatnonzero(rows)
    begin, end = (int(at[0]), int(at[-1]) + 1) if len(at) else (0, 0)
    if end - begin == len(at):
        return {name: value[begin:end] for name, value in flat.items()}
    return {name: value[at] for name, value in flat.items()}


def _needed(chosen: Mapping[str, str], made: Sequence[str], names: Sequence[str]) -> list[str]:
    """Columns to read: those chosen, and those by which rows are found and others made."""
    by = ["t_ns", *(("t_mono_ns", "seq", "part") if made else ())]
    read = [name for name, of in chosen.items() if of not in made]
    return list(dict.fromkeys([*read, *(name for name in by if name in names)]))


def _chosen(present: Sequence[str], tiles: int, asked: Sequence[str]) -> dict[str, str]:
    """Flat and logical name of every column asked for, in that order, each once."""
    flat = {f: name for name in present for f in KNOWN[name].flat_names(tiles)}
    if not asked:
        return flat
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
    return chosen


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


def write_csv(sink: BinaryIO, table: pa.Table) -> None:
    """A table as CSV, in which no text is a spreadsheet's formula."""
    with _CsvWriter(sink, table.schema) as writer:
        writer.write_table(table)


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
