"""The hash with which a Parquet file proves its bytes, without anything beside it.

It is of every byte with its own digits taken as zeros, and stands in the footer: no flipped bit
escapes it, in the footer's statistics as little as in a page. A sealed session's footer has a hash
of its own as well, of the footer alone: who reads a slice proves by it what columns, places and
statistics are said, in a millisecond, and the pages that it reads by their checksums.
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
FOOTER_HASH_KEY = b"foottile.footer_sha256"
FORMAT_KEY = b"foottile.format"
"""In the schema's metadata of what we write: frames, events and clocks."""
FORMAT = b"2"
FORMAT_WITHOUT_HASH = b"1"
"""Files of older versions: the same, without any hash of their own. They are read, not written."""
NO_HASH = b"0" * 64
_TEXT_OF_64 = b"\x18\x40"
"""Thrift's mark of a text of 64 bytes: behind its key it stands once in a footer."""
_REMEDY = "`foottile verify` says more; pull it again, or use a copy"
_MAGIC = b"PAR1"
_TAIL = 8
_BLOCK = 1 << 20


def write_file_hash(path: Path) -> None:
    """Put the hash of a Parquet file's bytes into its footer, where zeros stand for it.

    Before it that of the footer, if zeros stand for that, too. It is on the disk when this returns.

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
    begin, footer = _footer(file)
    at = _place(footer, FILE_HASH_KEY)
    if at is None:
        raise FileFormatError("no place for the file's hash", where=where)
    own = _place(footer, FOOTER_HASH_KEY)
    if own is not None:
        file.seek(begin + own)
        file.write(_footer_hash(footer, own, at).encode())
    at += begin
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
    if hashes is None and said.get(FORMAT_KEY, FORMAT_WITHOUT_HASH) != FORMAT_WITHOUT_HASH:
        raise DamagedFileError(
            "its hash is gone: it was changed, or another program has rewritten it",
            where=where,
            expected="the bytes as they were written",
            remedy=f"{_REMEDY}; export it to work on it with other programs",
        )
    if hashes is not None and hashes[0] != hashes[1]:
        raise DamagedFileError(
            "its bytes are not those that were sealed, by the hash in its footer",
            where=where,
            expected="the bytes as they were written",
            remedy=_REMEDY,
        )


def read_footer(path: Path) -> bytes:
    """The footer of a Parquet file, without the eight bytes behind it; empty if it has none.

    Raises:
        OSError: it cannot be read.
    """
    with path.open("rb") as file:
        return footer_in(file)


def footer_in(file: BinaryIO) -> bytes:
    """The same for a file that is open, wherever it is; no more is read of it.

    Raises:
        OSError: it cannot be read.
    """
    return _footer(file)[1]


def footer_hashes(footer: bytes) -> tuple[str, str] | None:
    """The hash that a footer states of itself, and the one that it has; None if it states none.

    It is of the footer with zeros for its own digits and for those of the file.
    """
    own, at = _place(footer, FOOTER_HASH_KEY), _place(footer, FILE_HASH_KEY)
    if own is None or at is None:
        return None
    stated = footer[own : own + len(NO_HASH)].decode("ascii", "replace")
    return stated, _footer_hash(footer, own, at)


def check_footer(hashes: tuple[str, str], *, where: str) -> None:
    """Refuse a footer that is not what was written.

    Args:
        hashes: as of `footer_hashes`.
        where: for errors.

    Raises:
        DamagedFileError: its hash is of other bytes.
    """
    if hashes[0] != hashes[1]:
        raise DamagedFileError(
            "the bytes of its footer are not those that were sealed, by its own hash",
            where=where,
            expected="the bytes as they were written",
            remedy=_REMEDY,
        )


def _hashes(file: BinaryIO) -> tuple[str, str] | None:
    begin, footer = _footer(file)
    at = _place(footer, FILE_HASH_KEY)
    if at is None:
        return None
    stated = footer[at : at + len(NO_HASH)].decode("ascii", "replace")
    return stated, _hash_without(file, begin + at)


def sha256_of(path: Path) -> str:
    """Hash of a file's bytes as they are, in hexadecimal digits.

    Raises:
        OSError: it cannot be read.
    """
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _footer(file: BinaryIO) -> tuple[int, bytes]:
    """Where in the file its footer begins, and the footer; empty if it is no Parquet file."""
    size = file.seek(0, os.SEEK_END)
    if size < _TAIL + len(_MAGIC):
        return size, b""
    file.seek(size - _TAIL)
    tail = file.read(_TAIL)
    length = int.from_bytes(tail[:4], "little")
    if tail[4:] != _MAGIC or length > size - _TAIL - len(_MAGIC):
        return size, b""
    begin = size - _TAIL - length
    file.seek(begin)
    return begin, file.read(length)


def _place(footer: bytes, key: bytes) -> int | None:
    """Where in a footer the digits of a hash stand."""
    before = key + _TEXT_OF_64
    at = footer.find(before)
    begin = at + len(before)
    if at < 0 or footer.find(before, begin) >= 0 or begin + len(NO_HASH) > len(footer):
        return None
    return begin


def _footer_hash(footer: bytes, *places: int) -> str:
    """Hash of a footer with zeros for the digits at these places."""
    hash_, begin = hashlib.sha256(), 0
    for at in sorted(places):
        hash_.update(memoryview(footer)[begin:at])
        hash_.update(NO_HASH)
        begin = at + len(NO_HASH)
    hash_.update(memoryview(footer)[begin:])
    return hash_.hexdigest()


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
