"""A sealed session: one Parquet file of flat columns, written and read here and nowhere else.

Integers are delta-encoded, floats byte-stream-split, all of it zstd (6 bytes a frame of four tiles
where CSV takes 54, performance.md). A row group is about a minute. The file appears whole or not at
all: it is written beside its place under a name of its own, synced, and renamed. Its footer states
hashes of its content and of its bytes (`storage.sessions.content_hash`), so that it proves itself.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from devices.errors import FileFormatError
from devices.frames import ArrayInfo, FrameBatch
from devices.inputs import check_file
from storage.durable import storage_errors, sync_folder, temporary_of
from storage.file_hash import (
    FILE_HASH_KEY,
    FORMAT,
    FORMAT_KEY,
    FORMAT_WITHOUT_HASH,
    check_hash,
    file_hashes,
    write_file_hash,
)
from storage.schema import (
    ARRAY_INFO_KEY,
    FRAMES,
    KNOWN,
    Array,
    array_info,
    flat_columns,
    from_flat,
)
from storage.sessions.content_hash import CONTENT_HASH_KEY, CONTENT_KEY, ContentDigest, content_hash

NOTES_KEY = b"foottile.notes"
EXPORT_KEY = b"foottile.export"
"""Only in what was made from a session: of which one, and what of it."""

ROW_GROUP_NS = 60_000_000_000


class SessionWriter:
    """Writes frames, and whatever goes with them, to a Parquet file that appears when sealed.

    Use as a context manager: an exception in the block leaves nothing behind.

    Args:
        path: where the sealed file will be. A file there is replaced at sealing, not before.
        info: description of the array.
        notes: anything else a reader should know; JSON-able, kept in the file's metadata.
    """

    def __init__(self, path: Path, info: ArrayInfo, notes: Mapping[str, object]) -> None:
        self.path = path
        self._temporary = temporary_of(path)
        self._info = info
        self._notes = dict(notes)
        self._waiting: list[dict[str, Array]] = []
        self._group_end_ns: int | None = None
        self._writer: pq.ParquetWriter | None = None
        self._digest = ContentDigest()
        self._head = b"", b""

    def add_notes(self, notes: Mapping[str, object]) -> None:
        """Add what became known later; must precede the first row group's end."""
        self._notes |= notes

    def append(self, frames: FrameBatch, extra: Mapping[str, Array]) -> None:
        """Add frames with their extra columns, which must be the same ones in every call.

        Args:
            frames: n frames.
            extra: columns of `storage.schema.KNOWN` by name, n rows each.
        """
        columns = {column.name: getattr(frames, column.name) for column in FRAMES} | dict(extra)
        begin = 0
        while begin < len(frames):
            t_mono_ns = int(frames.t_mono_ns[begin])
            if self._group_end_ns is not None and t_mono_ns < self._group_end_ns - ROW_GROUP_NS:
                self._write_group()  # the node was switched on again: another part begins
            fresh = self._group_end_ns is None
            if self._group_end_ns is None:
                self._group_end_ns = int(frames.t_mono_ns[begin]) + ROW_GROUP_NS
            inside = int(np.searchsorted(frames.t_mono_ns[begin:], self._group_end_ns))
            end = begin + max(inside, int(fresh))
            if end > begin:
                self._waiting.append({name: v[begin:end] for name, v in columns.items()})
            if end < len(frames):
                self._write_group()
            begin = end

    def seal(self) -> None:
        """Write what is left, sync, and give the file its name.

        Raises:
            FileFormatError: not one frame was appended.
            StorageError: the disk is full or not writable; nothing is left behind then.
        """
        self._write_group()
        if self._writer is None:
            raise FileFormatError("no frames to write", where=str(self.path))
        with self._errors():
            self._writer.add_key_value_metadata(self._digest.metadata(*self._head))
            self._writer.close()
            self._writer = None
            write_file_hash(self._temporary)
            self._temporary.replace(self.path)
            sync_folder(self.path.parent)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            if kind is None:
                self.seal()
        finally:
            self._discard()

    def _write_group(self) -> None:
        if not self._waiting:
            return
        names = list(self._waiting[0])
        values = {name: np.concatenate([piece[name] for piece in self._waiting]) for name in names}
        self._waiting = []
        self._group_end_ns = None
        fields, arrays = zip(*flat_columns([KNOWN[name] for name in names], values), strict=True)
        if self._writer is None:
            info, notes = self._info.model_dump_json(), json.dumps(self._notes, sort_keys=True)
            self._head = info.encode(), notes.encode()
        info_text, notes_text = self._head
        schema = pa.schema(
            list(fields),
            metadata={FORMAT_KEY: FORMAT, ARRAY_INFO_KEY: info_text, NOTES_KEY: notes_text},
        )
        table = pa.Table.from_arrays(list(arrays), schema=schema)
        with self._errors():
            if self._writer is None:
                self._writer = pq.ParquetWriter(
                    self._temporary, table.schema, **parquet_options(table.schema)
                )
            self._writer.write_table(table, row_group_size=len(table))
        self._digest.feed(table)

    def _errors(self) -> AbstractContextManager[None]:
        return storage_errors(
            self.path, "Free space on the disk, or write elsewhere; nothing was left behind"
        )

    def _discard(self) -> None:
        try:
            if self._writer is not None:
                # A file that is thrown away needs no footer, and a full disk has no room for one.
                with suppress(OSError, pa.ArrowException):
                    self._writer.close()
                self._writer = None
        finally:
            self._temporary.unlink(missing_ok=True)


def parquet_options(schema: pa.Schema) -> dict[str, Any]:
    """How every Parquet file of ours is written."""
    return {
        "compression": "zstd",
        "use_dictionary": [f.name for f in schema if pa.types.is_string(f.type)],
        "write_page_checksum": True,  # packed integers do not show a flipped bit
        "column_encoding": {f.name: e for f in schema if (e := _encoding(f.type))},
    }


def _encoding(type_: pa.DataType) -> str | None:
    if pa.types.is_floating(type_):
        return "BYTE_STREAM_SPLIT"
    if pa.types.is_integer(type_):
        return "DELTA_BINARY_PACKED"
    return None


class SessionReader:
    """Reads what `SessionWriter` wrote, one row group at a time."""

    def __init__(self, path: Path, *, is_checked: bool = False) -> None:
        """Open a sealed session, whose every byte is held against the file's hash.

        Args:
            path: the file.
            is_checked: its bytes were held against the hash already.

        Raises:
            FileFormatError: no such file, not Parquet, not one of ours, or damaged.
        """
        self.path = path
        try:
            check_file(path)
            self._file = pq.ParquetFile(path, page_checksum_verification=True)
            schema = self._file.schema_arrow
        except Exception as error:  # damaged bytes may cause any error
            raise FileFormatError(
                f"cannot be read as Parquet: {error}", where=str(path), expected="a sealed session"
            ) from error
        metadata = schema.metadata or {}
        version = metadata.get(FORMAT_KEY)
        if version not in (FORMAT, FORMAT_WITHOUT_HASH):
            raise FileFormatError(
                f"its format is {version!r}" if version else "it states no format",
                where=str(path),
                expected=f"a session of format {FORMAT.decode()}, written by foottile",
                remedy="Update foottile" if version else "",
            )
        if not is_checked:
            self._check_bytes(metadata)
        self.info = array_info(schema, where=str(path))
        self.notes = _notes(metadata.get(NOTES_KEY), where=str(path))
        self.format = version
        self.content_sha256, self.content = self._content(metadata)
        self.column_names = frozenset(schema.names)
        tiles = len(self.info.tiles)
        if f"padc_{tiles}" in schema.names:
            raise FileFormatError(
                f"it describes {tiles} tiles and has columns of more", where=str(path)
            )
        self.frame_count = self._file.metadata.num_rows
        if not self.frame_count:
            raise FileFormatError("the session has no frames", where=str(path))

    def _check_bytes(self, said: Mapping[bytes, bytes]) -> None:
        try:
            hashes = file_hashes(self.path)
        except OSError as error:
            raise FileFormatError(f"cannot be read: {error}", where=str(self.path)) from error
        check_hash(hashes, said, where=str(self.path))

    def _content(self, metadata: Mapping[bytes, bytes]) -> tuple[str | None, dict[str, Any] | None]:
        """What the file says of its content; None if another program wrote it last."""
        said = self._file.metadata.metadata or {}
        content, stated = said.get(CONTENT_KEY), said.get(CONTENT_HASH_KEY)
        if content is None or stated is None:
            return None, None
        found = content_hash(metadata[ARRAY_INFO_KEY], metadata[NOTES_KEY], content)
        if found.encode() != stated:
            raise FileFormatError(
                "its description of array and session is not the one that was sealed",
                where=str(self.path),
                expected=f"content with the hash {stated[:64]!r}, found {found}",
            )
        return found, json.loads(content)

    def tables(self) -> Iterator[pa.Table]:
        """All columns as they are in the file, a row group at a time.

        Raises:
            FileFormatError: a row group is damaged.
        """
        for group in range(self._file.num_row_groups):
            try:
                yield self._file.read_row_group(group)
            except (OSError, ValueError, pa.ArrowException) as error:
                raise FileFormatError(
                    f"row group {group} cannot be read: {error}", where=str(self.path)
                ) from error

    @property
    def identity(self) -> dict[str, object]:
        """Which session it is, for what is made from it: id, content hash, stated file hash."""
        said = self._file.metadata.metadata or {}
        session = self.notes.get("session")
        return {
            "session": session.get("id") if isinstance(session, dict) else None,
            "content_sha256": self.content_sha256,
            "file_sha256": said.get(FILE_HASH_KEY, b"").decode("ascii", "replace") or None,
        }

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def has(self, *names: str) -> bool:
        """Does the file have these columns (of `storage.schema.KNOWN`)?"""
        tiles = len(self.info.tiles)
        return all(self.column_names.issuperset(KNOWN[name].flat_names(tiles)) for name in names)

    def batches(self, *extra: str) -> Iterator[tuple[FrameBatch, dict[str, Array]]]:
        """Frames in the order they were written, with the extra columns asked for.

        Raises:
            FileFormatError: a column is missing, of another type, or damaged.
        """
        for values in self.columns(*(column.name for column in FRAMES), *extra):
            yield FrameBatch(**{column.name: values.pop(column.name) for column in FRAMES}), values

    def columns(self, *wanted: str) -> Iterator[dict[str, Array]]:
        """Some columns only, of `storage.schema.KNOWN`, a row group at a time.

        Raises:
            FileFormatError: as for `batches`.
        """
        tiles = len(self.info.tiles)
        names = [flat for name in wanted for flat in KNOWN[name].flat_names(tiles)]
        for group in range(self._file.num_row_groups):
            try:
                table = self._file.read_row_group(group, columns=names)
                values = {name: from_flat(KNOWN[name], table, tiles) for name in wanted}
            except (KeyError, ValueError, OSError, pa.ArrowException) as error:
                raise FileFormatError(
                    f"row group {group} cannot be read: {error}", where=str(self.path)
                ) from error
            yield values

    def frames(self) -> FrameBatch:
        """All frames at once.

        Raises:
            FileFormatError: as for `batches`.
        """
        return FrameBatch.concatenate([frames for frames, _ in self.batches()])


class CheckedFiles:
    """Sealed sessions that are opened often: each is held against its hash once, not every time.

    One whose stamps say that it is another file by now is held against its hash again; checksums
    of pages are looked at whenever they are read. May be used from several threads.
    """

    def __init__(self) -> None:
        self._known: dict[tuple[int, ...], None] = {}

    def open(self, path: Path) -> SessionReader:
        """Open a sealed session.

        Raises:
            FileFormatError: as for `SessionReader`.
        """
        stamps = _stamps(path)
        reader = SessionReader(path, is_checked=stamps in self._known)
        if stamps and stamps == _stamps(path):  # not replaced meanwhile
            while len(self._known) >= _KNOWN_MAX:
                self._known.pop(next(iter(self._known)), None)
            self._known[stamps] = None
        return reader


_KNOWN_MAX = 1000


def _stamps(path: Path) -> tuple[int, ...]:
    """What changes if a file does; empty if there is none."""
    try:
        found = path.stat()
    except OSError:
        return ()
    return found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns, found.st_ctime_ns


def _notes(text: bytes | None, *, where: str) -> dict[str, Any]:
    try:
        notes = json.loads(text or b"")
    except ValueError as error:
        raise FileFormatError(f"its notes are not readable: {error}", where=where) from error
    if not isinstance(notes, dict):
        raise FileFormatError("its notes are no JSON object", where=where)
    return notes
