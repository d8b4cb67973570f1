"""Footer of a sealed session: array, notes, content, and column positions.

Reading it takes time with the number of row groups and columns, and it never changes. So a server
caches it (`storage.sessions.reader`).

The *content hash* covers the values, whatever the row groups and encodings: every column's numbers,
the array's description and the notes. The *file hash* (`storage.parquet_hash`) covers the bytes.
Both are in the footer, and docs/formats.md has the few lines that compute them.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from devices.errors import FileFormatError
from devices.input_files import check_regular_file
from storage.parquet_hash import (
    FILE_HASH_KEY,
    FOOTER_HASH_KEY,
    FORMAT,
    FORMAT_KEY,
    HASH_PLACEHOLDER,
    footer_stated_and_actual_hash,
    read_footer_or_empty,
    read_footer_or_empty_from,
    read_stated_and_actual_hash,
    refuse_wrong_or_missing_file_hash,
    refuse_wrong_or_missing_footer_hash,
)
from storage.schema import ARRAY_INFO_KEY, COLUMNS_BY_NAME, read_array_info
from storage.sessions.ledger import FrameOrderChecker
from storage.sessions.time_axis import TimeAxis

CONTENT_KEY = b"foottile.content"
CONTENT_HASH_KEY = b"foottile.content_sha256"
_TILE_NUMBER = re.compile(r"_[0-9]+$")


class ContentDigest:
    """Incremental hash of columns, independent of how they are cut into tables."""

    def __init__(self) -> None:
        self.order = FrameOrderChecker()
        self._hashes: dict[str, Any] = {}

    def add_table_and_collect_disorder(self, table: pa.Table) -> None:
        """Hash the next rows and check their order; every table must have the same columns."""
        for name in table.column_names:
            column = column_bytes_for_hash(name, table.column(name))
            self._hashes.setdefault(name, hashlib.sha256()).update(column)
        names = [n for n in ("seq", "t_mono_ns", "t_ns", "part") if n in self._hashes]
        self.order.add_and_check_frames({n: table.column(n).to_numpy() for n in names})

    @property
    def column_hashes(self) -> dict[str, str]:
        """Hash of every column, in hexadecimal digits."""
        return {name: hash_.hexdigest() for name, hash_ in self._hashes.items()}

    def describe_content(self) -> dict[str, Any]:
        """Return the description of the content: counts, and the hash of every column."""
        parts = self.order.parts
        return {
            "frames": sum(part.frames for part in parts),
            "parts": [
                {name: getattr(part, name) for name in ("part", "seq_first", "seq_last", "frames")}
                for part in parts
            ],
            "columns": self.column_hashes,
        }

    def make_footer_entries_with_placeholders(
        self, array_info: bytes, notes: bytes
    ) -> dict[str, str]:
        """Return the footer's entries, with placeholders for the hashes of footer and file."""
        content = json.dumps(self.describe_content())
        return {
            CONTENT_KEY.decode(): content,
            CONTENT_HASH_KEY.decode(): compute_content_hash(array_info, notes, content.encode()),
            FOOTER_HASH_KEY.decode(): HASH_PLACEHOLDER.decode(),
            FILE_HASH_KEY.decode(): HASH_PLACEHOLDER.decode(),
        }


def column_bytes_for_hash(
    name: str, column: pa.ChunkedArray[Any] | pa.Array[Any]
) -> bytes | memoryview:
    """Return a column's bytes for hashing: little-endian numbers, nulls as missing values.

    A text is its UTF-8 and a zero byte.
    """
    if pa.types.is_string(column.type) or pa.types.is_large_string(column.type):
        return b"".join((text or "").encode() + b"\0" for text in column.to_pylist())
    if column.null_count:
        quantity = COLUMNS_BY_NAME.get(_TILE_NUMBER.sub("", name))
        missing = quantity.missing_value if quantity is not None else None
        if pa.types.is_floating(column.type):
            missing = float("nan")  # type: ignore[assignment]  # of this column's own type
        column = column.fill_null(pa.scalar(missing if missing is not None else 0, column.type))
    values = column.to_numpy() if isinstance(column, pa.ChunkedArray) else column.to_numpy(False)
    return np.ascontiguousarray(values).view(np.uint8).data


def compute_content_hash(array_info: bytes, notes: bytes, content: bytes) -> str:
    """Compute the hash over description, notes and column hashes."""
    return hashlib.sha256(b"\n".join((array_info, notes, content))).hexdigest()


NOTES_KEY = b"foottile.notes"
_MAGIC = b"PAR1"
FileStamps = tuple[int, ...]


class SealedFileFooter:
    """Parsed footer of a sealed file, with values that are computed from the file only once.

    Attributes:
        metadata: pyarrow's metadata, with which the file is opened again.
        info: the array.
        notes: other facts for readers.
        content: description of the file's content.
        content_sha256: hash of array, notes and description.
        column_names: names of the flat columns.
        frame_count: rows.
        size_bytes: length of the footer.
        is_file_verified: True: the file's hash is right.
        span_ns: first and last instant on the session's time axis; None: not computed yet.
        time_axis: time axis of the session; None: not computed yet.
    """

    def __init__(
        self,
        path: Path,
        *,
        skip_verification: bool = False,
        only_slices: bool = False,
        file: BinaryIO | None = None,
    ) -> None:
        """Read the footer of a file and verify it.

        Args:
            path: the file.
            skip_verification: skip the hashes: the file was verified already, or shall not be.
            only_slices: skip the file's hash: the footer's own is enough for slices, since pages
                are verified against their checksums when they are read.
            file: the open file, if it is not on this machine.

        Raises:
            FileFormatError: no such file, not Parquet, not one of ours, or damaged.
        """
        self._where = where = str(path)
        try:
            if file is None:
                check_regular_file(path)
            footer = read_footer_or_empty(path) if file is None else read_footer_or_empty_from(file)
            length = len(footer).to_bytes(4, "little")
            # The parsed bytes are the same that are verified against the hash.
            self.metadata = pq.read_metadata(
                pa.BufferReader(b"".join((_MAGIC, footer, length, _MAGIC)))
            )
            schema = self.metadata.schema.to_arrow_schema()
        except Exception as error:  # damaged bytes may cause any error
            raise FileFormatError(
                f"cannot be read as Parquet: {error}", where=where, expected="a sealed session"
            ) from error
        self.size_bytes = len(footer)
        self.is_file_verified = False
        self.schema_metadata: Mapping[bytes, bytes] = schema.metadata or {}
        hashes = footer_stated_and_actual_hash(footer)
        if hashes is None:
            self._check_format()  # of another program?
        if not skip_verification:
            refuse_wrong_or_missing_footer_hash(hashes, where=where)
        self._check_format()
        if not (skip_verification or only_slices) and file is None:
            self.verify_file_hash_once(path)
        self.info = read_array_info(schema, where=where)
        self.notes = _parse_notes(self.schema_metadata.get(NOTES_KEY), where=where)
        self.content_sha256, self.content = self._read_content()
        self.schema = schema
        self.column_names = frozenset(schema.names)
        tiles = len(self.info.tiles)
        if f"pressure_raw_{tiles}" in schema.names:
            raise FileFormatError(
                f"it describes {tiles} tiles and has columns of more", where=where
            )
        self.frame_count = self.metadata.num_rows
        if not self.frame_count:
            raise FileFormatError("the session has no frames", where=where)
        self.span_ns: tuple[int, int] | None = None
        self.time_axis: TimeAxis | None = None
        self._min_max_cache: dict[str, list[tuple[int, int] | None]] = {}

    def verify_file_hash_once(self, path: Path) -> None:
        """Verify the file against its hash, unless that was done.

        Raises:
            FileFormatError: it is damaged.
        """
        if self.is_file_verified:
            return
        try:
            hashes = read_stated_and_actual_hash(path)
        except OSError as error:
            raise FileFormatError(f"cannot be read: {error}", where=self._where) from error
        refuse_wrong_or_missing_file_hash(hashes, where=self._where)
        self.is_file_verified = True

    @cached_property
    def rows_by_group(self) -> list[int]:
        """Number of rows of every row group."""
        return [self.metadata.row_group(i).num_rows for i in range(self.metadata.num_row_groups)]

    def read_min_max_by_row_group(self, name: str) -> list[tuple[int, int] | None]:
        """Return minimum and maximum of an integer column in every row group.

        None without statistics, and for a missing column.
        """
        if name not in self._min_max_cache:
            self._min_max_cache[name] = [
                self._read_min_max(name, i) for i in range(len(self.rows_by_group))
            ]
        return self._min_max_cache[name]

    def _read_min_max(self, name: str, group: int) -> tuple[int, int] | None:
        if name not in self.column_names:
            return None
        column = self.metadata.row_group(group).column(self.schema.get_field_index(name))
        statistics: Any = column.statistics if column.is_stats_set else None
        if statistics is None or not statistics.has_min_max or not isinstance(statistics.min, int):
            return None
        return statistics.min, statistics.max

    def _check_format(self) -> None:
        version = self.schema_metadata.get(FORMAT_KEY)
        if version != FORMAT:
            raise FileFormatError(
                f"its format is {version!r}" if version else "it states no format",
                where=self._where,
                expected=f"a session of format {FORMAT.decode()}, written by foottile",
                remedy="Update foottile" if version else "",
            )

    def _read_content(self) -> tuple[str, dict[str, Any]]:
        """Return the content's hash and description."""
        metadata = self.metadata.metadata or {}
        content, stated = metadata.get(CONTENT_KEY), metadata.get(CONTENT_HASH_KEY)
        if content is None or stated is None:
            raise FileFormatError(
                "it has no hashes: another program has rewritten it", where=self._where
            )
        found = compute_content_hash(
            self.schema_metadata[ARRAY_INFO_KEY], self.schema_metadata[NOTES_KEY], content
        )
        if found.encode() != stated:
            raise FileFormatError(
                "its description of array and session has changed since it was sealed",
                where=self._where,
                expected=f"content with the hash {stated[:64]!r}, found {found}",
            )
        description: dict[str, Any] = json.loads(content)
        return found, description


def _parse_notes(text: bytes | None, *, where: str) -> dict[str, Any]:
    try:
        notes = json.loads(text or b"")
    except ValueError as error:
        raise FileFormatError(f"its notes are not readable: {error}", where=where) from error
    if not isinstance(notes, dict):
        raise FileFormatError("its notes are no JSON object", where=where)
    return notes


def read_file_stamps_or_empty(path: Path) -> FileStamps:
    """Return device, inode, size and times, which change with a file; empty if there is none."""
    try:
        found = path.stat()
    except OSError:
        return ()
    return found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns, found.st_ctime_ns
