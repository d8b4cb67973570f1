"""A session, or a slice of it, as a stream of bytes in another format: memory stays bounded.

Columns are the flat ones of a sealed file, whatever the format. What an emulated or a measured
session has is what is given; nothing is resampled.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.parquet as pq

from devices.errors import UsageError
from devices.frames import ArrayInfo, FrameBatch
from storage.clock.table import ClockTable
from storage.schema import ARRAY_INFO_KEY, FRAMES, KNOWN, SERVER_TIME, Array, flat_columns
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

_SERVER_TIME = {column.name for column in SERVER_TIME}

Pieces = Iterable[tuple[FrameBatch, Mapping[str, Array]]]


@dataclass(frozen=True)
class Slice:
    """Which rows and columns.

    Attributes:
        start_s: from so many seconds after the first frame on; None: from the beginning.
        end_s: before so many seconds; None: to the end.
        columns: names of columns, either of one tile (`force_n_0`) or of all (`force_n`); empty:
            all there are.
    """

    start_s: float | None = None
    end_s: float | None = None
    columns: tuple[str, ...] = ()

    @property
    def is_all(self) -> bool:
        """Is it the whole session?"""
        return self == Slice()


def export(
    pieces: Pieces,
    info: ArrayInfo,
    notes: Mapping[str, object],
    to: Format,
    part: Slice,
    clock: ClockTable | None = None,
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
        source: which session it is of, and its hashes; for the metadata.

    Yields:
        Chunks of the file. There is a header even if no frame is in the slice.

    Raises:
        UsageError: a column is not there; raised before the first chunk.
    """
    if clock is not None:
        pieces = _with_server_time(pieces, clock)
        notes = {**notes, "clock": clock.summary().model_dump(mode="json")}
    chosen = {"start_s": part.start_s, "end_s": part.end_s, "columns": list(part.columns)}
    made_from = {**(source or {}), **chosen, "clock": "node" if clock is None else "server"}
    tables = _tables(pieces, info, notes, part, made_from)
    first = next(tables, None)
    if first is None:
        raise UsageError("the session has no frames")
    sink = _Sink()
    writer = _open(sink, first.schema, to)
    writer.write_table(first)
    yield sink.taken()
    for table in tables:
        if len(table):
            writer.write_table(table)
            yield sink.taken()
    writer.close()
    yield sink.taken()


def _tables(
    pieces: Pieces,
    info: ArrayInfo,
    notes: Mapping[str, object],
    part: Slice,
    made_from: Mapping[str, object],
) -> Iterator[pa.Table]:
    metadata: dict[bytes | str, bytes | str] = {
        ARRAY_INFO_KEY: info.model_dump_json().encode(),
        NOTES_KEY: json.dumps(notes, sort_keys=True).encode(),
        EXPORT_KEY: json.dumps(made_from).encode(),
    }
    begin_t_ns: int | None = None
    for frames, extra in pieces:
        if not len(frames):
            continue
        if begin_t_ns is None:
            begin_t_ns = int(frames.t_ns[0])
        values = {column.name: getattr(frames, column.name) for column in FRAMES} | dict(extra)
        rows = np.ones(len(frames), dtype=np.bool_)
        if part.start_s is not None:
            rows &= frames.t_ns >= begin_t_ns + round(part.start_s * 1e9)
        if part.end_s is not None:
            rows &= frames.t_ns < begin_t_ns + round(part.end_s * 1e9)
        wanted = _chosen(tuple(values), len(info.tiles), part.columns)
        logical = dict.fromkeys(name for name, _ in wanted)
        flat = {
            field.name: (field, array)
            for field, array in flat_columns(
                [KNOWN[name] for name in logical], {name: values[name][rows] for name in logical}
            )
        }
        chosen = [flat[name] for _, name in wanted]
        yield pa.Table.from_arrays(
            [array for _, array in chosen],
            schema=pa.schema([field for field, _ in chosen], metadata=metadata),
        )


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
                remedy="Ask for the clock `server` as well" if name in _SERVER_TIME else "",
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
            return pacsv.CSVWriter(sink, schema)
