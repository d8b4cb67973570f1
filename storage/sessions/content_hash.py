"""Hashes with which a sealed file proves itself, without anything beside it.

Two, because they answer two questions. The *content hash* is of what the file says, whatever its
row groups and encodings: of every column's numbers, of the array's description and of the notes.
The *file hash* is of every byte of the file with its own digits taken as zeros; no flipped bit
escapes it, in a footer's statistics as little as in a page. Both are in the footer (docs/formats.md
has the few lines that compute them).
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import pyarrow as pa

from devices.errors import FileFormatError
from storage.schema import KNOWN
from storage.sessions.frame_order import FrameOrder

CONTENT_KEY = b"foottile.content"
CONTENT_HASH_KEY = b"foottile.content_sha256"
FILE_HASH_KEY = b"foottile.file_sha256"

NO_HASH = b"0" * 64
_BEFORE_HASH = FILE_HASH_KEY + b"\x18\x40"
"""The key, then Thrift's mark of a text of 64 bytes: in a footer this stands once."""
_MAGIC = b"PAR1"
_TAIL = 8
_BLOCK = 1 << 20
_TILE_NUMBER = re.compile(r"_[0-9]+$")


class ContentDigest:
    """Hashes columns as they are written or read, in any cut into tables."""

    def __init__(self) -> None:
        self.order = FrameOrder()
        self._hashes: dict[str, Any] = {}

    def feed(self, table: pa.Table) -> None:
        """Take the next rows; every table must have the same columns in the same order."""
        for name in table.column_names:
            column = column_values(name, table.column(name))
            self._hashes.setdefault(name, hashlib.sha256()).update(column)
        names = [n for n in ("seq", "t_mono_ns", "t_ns", "part") if n in self._hashes]
        self.order.feed({n: table.column(n).to_numpy() for n in names})

    @property
    def columns(self) -> dict[str, str]:
        """Hash of every column, in hexadecimal digits."""
        return {name: hash_.hexdigest() for name, hash_ in self._hashes.items()}

    def content(self) -> dict[str, Any]:
        """What a file says of its content: counts, and the hash of every column."""
        parts = self.order.parts
        return {
            "frames": sum(part.frames for part in parts),
            "parts": [
                {name: getattr(part, name) for name in ("part", "seq_first", "seq_last", "frames")}
                for part in parts
            ],
            "columns": self.columns,
        }

    def metadata(self, array_info: bytes, notes: bytes) -> dict[str, str]:
        """The entries of the footer; the file hash follows when the file is whole."""
        content = json.dumps(self.content())
        return {
            CONTENT_KEY.decode(): content,
            CONTENT_HASH_KEY.decode(): content_hash(array_info, notes, content.encode()),
            FILE_HASH_KEY.decode(): NO_HASH.decode(),
        }


def column_values(name: str, column: pa.ChunkedArray[Any] | pa.Array[Any]) -> bytes | memoryview:
    """A column's bytes as they are hashed: little-endian numbers, what is null as it is in memory.

    A text is its UTF-8 and a zero byte.
    """
    if pa.types.is_string(column.type) or pa.types.is_large_string(column.type):
        return b"".join((text or "").encode() + b"\0" for text in column.to_pylist())
    if column.null_count:
        known = KNOWN.get(_TILE_NUMBER.sub("", name))
        missing = known.missing if known is not None else None
        if pa.types.is_floating(column.type):
            missing = float("nan")  # type: ignore[assignment]  # of this column's own type
        column = column.fill_null(pa.scalar(missing if missing is not None else 0, column.type))
    values = column.to_numpy() if isinstance(column, pa.ChunkedArray) else column.to_numpy(False)
    return np.ascontiguousarray(values).view(np.uint8).data


def content_hash(array_info: bytes, notes: bytes, content: bytes) -> str:
    """The one hash of all that a file says."""
    return hashlib.sha256(b"\n".join((array_info, notes, content))).hexdigest()


def write_file_hash(path: Path) -> None:
    """Put the hash of a Parquet file's bytes into its footer, where zeros stand for it.

    It is on the disk when this returns.

    Raises:
        OSError: it cannot be written.
        FileFormatError: no place was left for it.
    """
    with path.open("r+b") as file:
        at = _hash_place(file)
        if at is None:
            raise FileFormatError("no place for the file's hash", where=str(path))
        digits = _hash_without(file, at)
        file.seek(at)
        file.write(digits.encode())
        file.flush()
        os.fsync(file.fileno())


def file_hashes(path: Path) -> tuple[str, str] | None:
    """The file hash that a Parquet file states, and the one that it has; None if it states none.

    Raises:
        OSError: it cannot be read.
    """
    with path.open("rb") as file:
        at = _hash_place(file)
        if at is None:
            return None
        file.seek(at)
        return file.read(len(NO_HASH)).decode("ascii", "replace"), _hash_without(file, at)


def sha256_of(path: Path) -> str:
    """Hash of a file's bytes as they are, in hexadecimal digits.

    Raises:
        OSError: it cannot be read.
    """
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _hash_place(file: BinaryIO) -> int | None:
    """Where in the file its hash stands."""
    size = file.seek(0, os.SEEK_END)
    if size < _TAIL + len(_MAGIC):
        return None
    file.seek(size - _TAIL)
    tail = file.read(_TAIL)
    length = int.from_bytes(tail[:4], "little")
    if tail[4:] != _MAGIC or length > size - _TAIL - len(_MAGIC):
        return None
    file.seek(size - _TAIL - length)
    footer = file.read(length)
    at = footer.find(_BEFORE_HASH)
    if at < 0 or footer.count(_BEFORE_HASH) != 1 or at + len(_BEFORE_HASH) + 64 > length:
        return None
    return size - _TAIL - length + at + len(_BEFORE_HASH)


def _hash_without(file: BinaryIO, at: int) -> str:
    """Hash of the file with zeros for digits at `at`."""
    hash_ = hashlib.sha256()
    file.seek(0)
    left = at
    while left and (block := file.read(min(left, _BLOCK))):
        hash_.update(block)
        left -= len(block)
    hash_.update(NO_HASH)
    file.seek(at + len(NO_HASH))
    while block := file.read(_BLOCK):
        hash_.update(block)
    return hash_.hexdigest()
