"""SHA-256 that a Parquet file carries in its own footer, over all of its bytes.

The hash's own digits count as zeros. So it covers every byte, in the footer's statistics as well as
in a page. A sealed session's footer also has a hash of the footer alone: a reader of a slice checks
columns, offsets and statistics by it in a millisecond, and the pages that it reads by their
checksums.

Small tables, such as markers and clocks of a session, have the file's hash, and a checksum of every
page.
"""

from __future__ import annotations

import hashlib
import io
import os
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import pyarrow as pa
import pyarrow.parquet as pq

from devices.errors import DamagedFileError, FileFormatError
from storage.durable_files import read_small_file, write_atomically

FILE_HASH_KEY = b"foottile.file_sha256"
FOOTER_HASH_KEY = b"foottile.footer_sha256"
FORMAT_KEY = b"foottile.format"
"""Key of the format version in the schema's metadata of frames, markers and clocks."""
FORMAT = b"2"
HASH_PLACEHOLDER = b"0" * 64
"""Placeholder for the digits of a hash."""
_THRIFT_TEXT_64 = b"\x18\x40"
"""Thrift's prefix of a 64-byte text: behind its key it occurs once in a footer."""
_REMEDY = "`foottile verify` says more; pull it again, or use a copy"
_MAGIC = b"PAR1"
_TAIL = 8
_BLOCK = 1 << 20


def fill_hash_placeholders_and_sync(path: Path) -> None:
    """Fill in the hashes of a Parquet file's footer and bytes, where placeholders stand.

    The footer's is optional. The file is on the disk when this returns.

    Raises:
        OSError: it cannot be written.
        FileFormatError: the file has no placeholder for its hash.
    """
    with path.open("r+b") as file:
        _fill_hash_placeholders(file, where=str(path))
        file.flush()
        os.fsync(file.fileno())


def _fill_hash_placeholders(file: BinaryIO, *, where: str) -> None:
    """Fill in the hashes of an open or in-memory Parquet file, where placeholders stand.

    Raises:
        OSError: it cannot be written.
        FileFormatError: the file has no placeholder for its hash.
    """
    begin, footer = _footer(file)
    at = _find_digits(footer, FILE_HASH_KEY)
    if at is None:
        raise FileFormatError("the footer has no placeholder for the file's hash", where=where)
    own = _find_digits(footer, FOOTER_HASH_KEY)
    if own is not None:
        file.seek(begin + own)
        file.write(_footer_hash(footer, own, at).encode())
    at += begin
    digits = _hash_without(file, at)
    file.seek(at)
    file.write(digits.encode())


class HashPair(NamedTuple):
    """Hash of a file: as its footer states, and as computed."""

    stated: str
    actual: str


def read_stated_and_actual_hash(path: Path) -> HashPair | None:
    """Return a Parquet file's stated and actual hash; None if it states none.

    Raises:
        OSError: it cannot be read.
    """
    with path.open("rb") as file:
        return _hashes(file)


def refuse_wrong_or_missing_file_hash(hashes: HashPair | None, *, where: str) -> None:
    """Refuse a Parquet file whose bytes have changed since it was written.

    Checksums of pages alone are not enough: a flip in the footer may give a column the name or the
    place of another one.

    Args:
        hashes: stated and actual, as of `read_stated_and_actual_hash`.
        where: for errors.

    Raises:
        DamagedFileError: its hash is wrong, or missing.
    """
    _check_hash(
        hashes, "its bytes have changed since it was sealed, by the hash in its footer", where
    )


def read_footer_or_empty(path: Path) -> bytes:
    """Return the footer of a Parquet file, without the eight bytes behind it; empty if it has none.

    Raises:
        OSError: it cannot be read.
    """
    with path.open("rb") as file:
        return read_footer_or_empty_from(file)


def read_footer_or_empty_from(file: BinaryIO) -> bytes:
    """Read only the footer of an open Parquet file; empty if it has none.

    Raises:
        OSError: it cannot be read.
    """
    return _footer(file)[1]


def footer_stated_and_actual_hash(footer: bytes) -> HashPair | None:
    """Return a footer's stated and actual hash of itself; None if it states none.

    The digits of both hashes, the footer's and the file's, count as zeros.
    """
    own, at = _find_digits(footer, FOOTER_HASH_KEY), _find_digits(footer, FILE_HASH_KEY)
    if own is None or at is None:
        return None
    stated = footer[own : own + len(HASH_PLACEHOLDER)].decode("ascii", "replace")
    return HashPair(stated, _footer_hash(footer, own, at))


def refuse_wrong_or_missing_footer_hash(hashes: HashPair | None, *, where: str) -> None:
    """Refuse a footer whose bytes have changed since it was written.

    Args:
        hashes: as of `footer_stated_and_actual_hash`.
        where: for errors.

    Raises:
        DamagedFileError: its hash is wrong, or missing.
    """
    what = "the bytes of its footer have changed since it was sealed, by the footer's hash"
    _check_hash(hashes, what, where)


def _check_hash(hashes: HashPair | None, change: str, where: str) -> None:
    if hashes is not None and hashes.stated == hashes.actual:
        return
    remedy = _REMEDY
    if hashes is None:
        change = "its hash is gone: it was changed, or another program has rewritten it"
        remedy += "; export it to work on it with other programs"
    expected = "the bytes as they were written"
    raise DamagedFileError(change, where=where, expected=expected, remedy=remedy)


def _hashes(file: BinaryIO) -> HashPair | None:
    begin, footer = _footer(file)
    at = _find_digits(footer, FILE_HASH_KEY)
    if at is None:
        return None
    stated = footer[at : at + len(HASH_PLACEHOLDER)].decode("ascii", "replace")
    return HashPair(stated, _hash_without(file, begin + at))


def compute_sha256(path: Path) -> str:
    """Return the SHA-256 of a file's bytes in hexadecimal digits.

    Raises:
        OSError: it cannot be read.
    """
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _footer(file: BinaryIO) -> tuple[int, bytes]:
    """Return the offset and bytes of a file's footer; empty if it is no Parquet file."""
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


def _find_digits(footer: bytes, key: bytes) -> int | None:
    """Return the offset of a hash's digits in a footer; None if there is no unique one."""
    before = key + _THRIFT_TEXT_64
    at = footer.find(before)
    begin = at + len(before)
    if at < 0 or footer.find(before, begin) >= 0 or begin + len(HASH_PLACEHOLDER) > len(footer):
        return None
    return begin


def _footer_hash(footer: bytes, *places: int) -> str:
    """Return the hash of a footer with zeros for the digits at these places."""
    hash_, begin = hashlib.sha256(), 0
    for at in sorted(places):
        hash_.update(memoryview(footer)[begin:at])
        hash_.update(HASH_PLACEHOLDER)
        begin = at + len(HASH_PLACEHOLDER)
    hash_.update(memoryview(footer)[begin:])
    return hash_.hexdigest()


def _hash_without(file: BinaryIO, at: int) -> str:
    """Return the hash of the file with zeros for the digits at `at`."""
    hash_ = hashlib.sha256()
    file.seek(0)
    left = at
    while left and (block := file.read(min(left, _BLOCK))):
        hash_.update(block)
        left -= len(block)
    hash_.update(HASH_PLACEHOLDER)
    file.seek(at + len(HASH_PLACEHOLDER))
    while block := file.read(_BLOCK):
        hash_.update(block)
    return hash_.hexdigest()


def write_hashed_table(
    path: Path, table: pa.Table, *, is_uncompressed: bool = False, max_group_rows: int | None = None
) -> None:
    """Write a table with its hash, atomically.

    Args:
        path: the file; an existing one is replaced.
        table: its content.
        is_uncompressed: write without compression and dictionaries, which save little in a table of
            few rows: reading takes less than half of the time.
        max_group_rows: most rows of a row group; None: nearly all rows in one.

    Raises:
        StorageError: the disk is full or not writable; raises as `open_for_atomic_write`.
    """
    metadata = {**(table.schema.metadata or {}), FORMAT_KEY: FORMAT}
    table = table.replace_schema_metadata(metadata)
    sink = io.BytesIO()
    compression = "none" if is_uncompressed else "zstd"
    options: dict[str, Any] = {"compression": compression, "use_dictionary": not is_uncompressed}
    with pq.ParquetWriter(sink, table.schema, write_page_checksum=True, **options) as file:
        file.write_table(table, row_group_size=max_group_rows)
        file.add_key_value_metadata({FILE_HASH_KEY.decode(): HASH_PLACEHOLDER.decode()})
    _fill_hash_placeholders(sink, where=str(path))
    write_atomically(path, sink.getvalue())


def read_hashed_table(path: Path) -> pa.Table:
    """Read a table and verify its hash; the caller checks its columns.

    Raises:
        FileNotFoundError: there is no such file.
        DamagedFileError: its hash is wrong or missing, or it is no table.
        StorageError: it cannot be read now.
    """
    return parse_hashed_table(read_small_file(path), where=str(path))


def parse_hashed_table(content: bytes, *, where: str) -> pa.Table:
    """Parse a table from a file's content and verify its hash.

    Raises:
        DamagedFileError: its hash is wrong or missing, or it is no table.
    """
    refuse_wrong_or_missing_file_hash(_hashes(io.BytesIO(content)), where=where)
    try:
        with pq.ParquetFile(pa.BufferReader(content), page_checksum_verification=True) as file:
            # On this thread: if one of Arrow's released `content` last while the interpreter ends,
            # the process would abort.
            table = file.read(use_threads=False)
            table.validate(full=True)
    except Exception as error:  # damaged bytes may cause any error
        raise DamagedFileError(
            f"cannot be read as a table: {' '.join(str(error).split())[:300]}", where=where
        ) from error
    return table
