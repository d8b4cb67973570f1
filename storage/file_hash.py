"""The hash with which a Parquet file proves its bytes, without anything beside it.

It is of every byte with its own digits taken as zeros, and stands in the footer: no flipped bit
escapes it, in the footer's statistics as little as in a page.
"""

from __future__ import annotations

import hashlib
import io
import os
from collections.abc import Mapping
from pathlib import Path
from typing import BinaryIO

from devices.errors import DamagedFileError, FileFormatError

FILE_HASH_KEY = b"foottile.file_sha256"
FORMAT_KEY = b"foottile.format"
"""In the schema's metadata of what we write: frames, events and clocks."""
FORMAT = b"2"
FORMAT_WITHOUT_HASH = b"1"
"""Files of older versions: the same, without any hash of their own. They are read, not written."""
NO_HASH = b"0" * 64
_BEFORE_HASH = FILE_HASH_KEY + b"\x18\x40"
"""The key, then Thrift's mark of a text of 64 bytes: in a footer this stands once."""
_MAGIC = b"PAR1"
_TAIL = 8
_BLOCK = 1 << 20


def write_file_hash(path: Path) -> None:
    """Put the hash of a Parquet file's bytes into its footer, where zeros stand for it.

    It is on the disk when this returns.

    Raises:
        OSError: it cannot be written.
        FileFormatError: no place was left for it.
    """
    with path.open("r+b") as file:
        put_hash(file, where=str(path))
        file.flush()
        os.fsync(file.fileno())


def put_hash(file: BinaryIO, *, where: str) -> None:
    """The same for a file that is open, or in memory.

    Raises:
        OSError: it cannot be written.
        FileFormatError: no place was left for it.
    """
    at = _hash_place(file)
    if at is None:
        raise FileFormatError("no place for the file's hash", where=where)
    digits = _hash_without(file, at)
    file.seek(at)
    file.write(digits.encode())


def file_hashes(path: Path) -> tuple[str, str] | None:
    """The file hash that a Parquet file states, and the one that it has; None if it states none.

    Raises:
        OSError: it cannot be read.
    """
    with path.open("rb") as file:
        return _hashes(file)


def hashes_of(content: bytes) -> tuple[str, str] | None:
    """The same for a file's content."""
    return _hashes(io.BytesIO(content))


def check_hash(hashes: tuple[str, str] | None, said: Mapping[bytes, bytes], *, where: str) -> None:
    """Refuse a Parquet file that is not what was written.

    Checksums of pages alone are not enough: a flip in the footer may give a column the name or the
    place of another one. What never was a file of ours, and what is of an older version, states no
    hash and no format that has one, and passes.

    Args:
        hashes: as of `file_hashes`.
        said: the metadata of its schema.
        where: for errors.

    Raises:
        DamagedFileError: its hash is of other bytes, or gone.
    """
    remedy = "`foottile verify` says more; pull it again, or use a copy"
    if hashes is None and said.get(FORMAT_KEY, FORMAT_WITHOUT_HASH) != FORMAT_WITHOUT_HASH:
        raise DamagedFileError(
            "its hash is gone: it was changed, or another program has rewritten it",
            where=where,
            expected="the bytes as they were written",
            remedy=f"{remedy}; export it to work on it with other programs",
        )
    if hashes is not None and hashes[0] != hashes[1]:
        raise DamagedFileError(
            "its bytes are not those that were sealed, by the hash in its footer",
            where=where,
            expected="the bytes as they were written",
            remedy=remedy,
        )


def _hashes(file: BinaryIO) -> tuple[str, str] | None:
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
