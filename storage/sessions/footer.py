"""Footer of a sealed session: array, notes, content, and column positions.

Reading it takes time with the number of row groups and columns, and it never changes. So a server
caches it (`storage.sessions.verified_file_cache`).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, BinaryIO

import pyarrow as pa
import pyarrow.parquet as pq

from devices.errors import FileFormatError
from devices.input_files import check_regular_file
from storage.parquet_hash import (
    FORMAT,
    FORMAT_KEY,
    check_file_hash,
    check_footer_hash,
    footer_stated_and_actual_hash,
    read_footer_or_empty,
    read_footer_or_empty_from,
    read_stated_and_actual_hash,
)
from storage.schema import ARRAY_INFO_KEY, read_array_info
from storage.sessions.content_hash import CONTENT_HASH_KEY, CONTENT_KEY, compute_content_hash
from storage.sessions.time_axis import TimeAxis

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
            check_footer_hash(hashes, where=where)
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
        check_file_hash(hashes, where=self._where)
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
