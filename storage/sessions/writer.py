"""Writer of a sealed session: one Parquet file of flat columns.

Integers are delta-encoded or have a dictionary, floats are byte-stream-split, all compressed by
zstd (6 bytes a frame of four tiles where CSV takes 54, performance.md). No integer is
byte-stream-split: DuckDB before 2.0 and pyarrow before 16 do not read that. A row group is about a
minute, in sessions of more than an hour up to five: each row group costs a reader of the footer
some time. The file appears completely or not at all: it is written under a temporary name, synced,
and renamed. Its footer has hashes of its content, of its bytes and of itself
(`storage.sessions.footer`, `storage.parquet_hash`).
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from typing import Any, Self

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from devices.errors import FileFormatError
from devices.frames import ArrayInfo, FrameBatch
from storage.durable_files import make_temporary_path, sync_folder, translate_storage_errors
from storage.parquet_hash import FORMAT, FORMAT_KEY, fill_hash_placeholders_and_sync
from storage.schema import ARRAY_INFO_KEY, COLUMNS_BY_NAME, MEASURED_COLUMNS, Array, to_flat_columns
from storage.sessions.footer import NOTES_KEY, ContentDigest

EXPORT_KEY = b"foottile.export"
"""Key of an export's source: the session, and the selection of its frames."""
EXPORT_COLUMN = "about"
"""Column of an export's source in CSV, which has no metadata: its first cell has the JSON."""

MIN_ROW_GROUP_NS = 60_000_000_000
"""Duration of the shortest row group, and of the pieces of longer ones."""
ROW_GROUP_GROWTH_RATIO = 30
"""Ratio of the rows before a row group to its own: in ten hours there are 180 instead of 600."""
MAX_ROW_GROUP_PIECES = 5
"""Most pieces of a row group: with eight tiles and estimates it takes 45 MB to write."""
ZSTD_LEVEL = 5
"""Compression level of zstd."""
_DELTA_ENCODED_COLUMNS = frozenset({"servo_counts", "servo_age_us", "part", "pressure_raw"})
"""Delta-encoded integers of short steps, beside those of 64 bits (frame numbers and instants)."""


class SealedFileWriter:
    """Writer of frames and their extra columns to a Parquet file that appears when sealed.

    Use as a context manager: after an exception in the block no file is left behind.

    Args:
        path: path of the sealed file. An existing file is replaced at sealing, not before.
        info: description of the array.
        notes: other facts for readers; JSON-able, stored in the file's metadata.
    """

    def __init__(self, path: Path, info: ArrayInfo, notes: Mapping[str, object]) -> None:
        self.path = path
        self._temporary = make_temporary_path(path)
        self._info = info
        self._notes = dict(notes)
        self._waiting: list[dict[str, Array]] = []
        self._piece_end_ns: int | None = None
        self._group: list[pa.Table] = []
        self._pieces = 0
        self._writer: pq.ParquetWriter | None = None
        self._digest = ContentDigest()
        self._head = b"", b""

    def add_notes_before_first_row_group(self, notes: Mapping[str, object]) -> None:
        """Add notes; only before the first minute of frames is written.

        Raises:
            RuntimeError: the file has its notes already.
        """
        if self._writer is not None:
            raise RuntimeError("notes after the file's head")
        self._notes |= notes

    def append_frames(self, frames: FrameBatch, extra_columns: Mapping[str, Array]) -> None:
        """Append frames with their extra columns, which must be the same ones in every call.

        Args:
            frames: n frames.
            extra_columns: columns of `storage.schema.COLUMNS_BY_NAME` by name, n rows each.
        """
        columns = {column.name: getattr(frames, column.name) for column in MEASURED_COLUMNS} | dict(
            extra_columns
        )
        begin = 0
        while begin < len(frames):
            t_mono_ns = int(frames.t_mono_ns[begin])
            if self._piece_end_ns is not None and t_mono_ns < self._piece_end_ns - MIN_ROW_GROUP_NS:
                self._flush_piece()  # the node was rebooted: another part begins
                self._write_row_group()
            fresh = self._piece_end_ns is None
            if self._piece_end_ns is None:
                self._piece_end_ns = int(frames.t_mono_ns[begin]) + MIN_ROW_GROUP_NS
            inside = int(np.searchsorted(frames.t_mono_ns[begin:], self._piece_end_ns))
            end = begin + max(inside, int(fresh))
            if end > begin:
                self._waiting.append({name: v[begin:end] for name, v in columns.items()})
            if end < len(frames):
                self._flush_piece()
            begin = end

    def seal(self) -> None:
        """Write the remaining frames, sync, and rename the file to its final name.

        Raises:
            FileFormatError: no frame was appended.
            StorageError: the disk is full or not writable; raises as `open_for_atomic_write`.
        """
        self._flush_piece()
        self._write_row_group()
        if self._writer is None:
            raise FileFormatError("no frames to write", where=str(self.path))
        with self._translate_errors():
            self._writer.add_key_value_metadata(
                self._digest.make_footer_entries_with_placeholders(*self._head)
            )
            self._writer.close()
            self._writer = None
            fill_hash_placeholders_and_sync(self._temporary)
            self._temporary.replace(self.path)
        with translate_storage_errors(
            self.path, "The file is complete; a power cut may lose its name"
        ):
            sync_folder(self.path.parent)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        try:
            if kind is None:
                self.seal()
        finally:
            self._discard()

    def _flush_piece(self) -> None:
        """Convert waiting frames to a table, which takes half of the memory."""
        if not self._waiting:
            return
        names = list(self._waiting[0])
        values = {name: np.concatenate([piece[name] for piece in self._waiting]) for name in names}
        self._waiting = []
        self._piece_end_ns = None
        columns = to_flat_columns([COLUMNS_BY_NAME[name] for name in names], values, self._notes)
        fields, arrays = zip(*columns, strict=True)
        if not self._pieces:
            info, notes = self._info.model_dump_json(), json.dumps(self._notes, sort_keys=True)
            self._head = info.encode(), notes.encode()
        info_text, notes_text = self._head
        schema = pa.schema(
            list(fields),
            metadata={FORMAT_KEY: FORMAT, ARRAY_INFO_KEY: info_text, NOTES_KEY: notes_text},
        )
        table = pa.Table.from_arrays(list(arrays), schema=schema)
        self._digest.add_table_and_collect_disorder(table)
        self._group.append(table)
        self._pieces += 1
        if len(self._group) >= min(self._pieces // ROW_GROUP_GROWTH_RATIO, MAX_ROW_GROUP_PIECES):
            self._write_row_group()

    def _write_row_group(self) -> None:
        if not self._group:
            return
        table = pa.concat_tables(self._group)
        self._group = []
        with self._translate_errors():
            if self._writer is None:
                self._writer = pq.ParquetWriter(
                    self._temporary, table.schema, **parquet_options(table.schema)
                )
            self._writer.write_table(table, row_group_size=len(table))

    def _translate_errors(self) -> AbstractContextManager[None]:
        return translate_storage_errors(
            self.path, "Free space on the disk, or write elsewhere; nothing was left behind"
        )

    def _discard(self) -> None:
        try:
            if self._writer is not None:
                # A discarded file needs no footer, and a full disk has no room for one.
                with suppress(OSError, pa.ArrowException):
                    self._writer.close()
                self._writer = None
        finally:
            self._temporary.unlink(missing_ok=True)


def parquet_options(schema: pa.Schema) -> dict[str, Any]:
    """Return the options of `pq.ParquetWriter` for a sealed file of flat columns.

    Without `column_encoding` readers of 2021 can open the file, which is then 20 to 60 % larger.
    """
    encodings = {field.name: _choose_encoding(field) for field in schema}
    return {
        "compression": "zstd",
        "compression_level": ZSTD_LEVEL,
        "use_dictionary": [name for name, encoding in encodings.items() if encoding is None],
        "write_page_checksum": True,  # packed integers do not show a flipped bit
        "column_encoding": {name: e for name, e in encodings.items() if e is not None},
    }


def _choose_encoding(field: pa.Field[Any]) -> str | None:
    """Return a column's encoding; None: a dictionary, for texts and noisy integers."""
    if pa.types.is_floating(field.type):
        return "BYTE_STREAM_SPLIT"
    quantity = re.sub(r"_\d+$", "", field.name)
    is_long = pa.types.is_primitive(field.type) and field.type.bit_width == 64
    return "DELTA_BINARY_PACKED" if is_long or quantity in _DELTA_ENCODED_COLUMNS else None
