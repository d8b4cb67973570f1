"""Small Parquet tables that prove themselves: events and clocks beside a session's frames.

The hash of their bytes is in the footer (`storage.file_hash`), and every page has a checksum. Older
versions wrote neither: such a table is read and called unproven, and has both when it is next
written.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from devices.errors import DamagedFileError
from storage.durable import read_whole, write_whole
from storage.file_hash import (
    FILE_HASH_KEY,
    FORMAT,
    FORMAT_KEY,
    NO_HASH,
    check_hash,
    hashes_of,
    put_hash,
)


@dataclass(frozen=True)
class CheckedTable:
    """What a file holds."""

    table: pa.Table
    is_proven: bool
    """False: it states no hash, so it may have changed since an older version wrote it."""


def write_table(
    path: Path, table: pa.Table, *, is_plain: bool = False, group_rows: int | None = None
) -> None:
    """Write a table with its hash, whole or not at all.

    Args:
        path: of the file; one that is there is replaced.
        table: what it is to hold.
        is_plain: neither compressed nor with dictionaries, of which a table of few rows has little:
            it is read in less than half of the time.
        group_rows: of a row group at most; None: as many as there are, nearly.

    Raises:
        StorageError: the disk is full or not writable; raises as `whole_file`.
    """
    said = {**(table.schema.metadata or {}), FORMAT_KEY: FORMAT}
    table = table.replace_schema_metadata(said)
    sink = io.BytesIO()
    compression = "none" if is_plain else "zstd"
    options: dict[str, Any] = {"compression": compression, "use_dictionary": not is_plain}
    with pq.ParquetWriter(sink, table.schema, write_page_checksum=True, **options) as file:
        file.write_table(table, row_group_size=group_rows)
        file.add_key_value_metadata({FILE_HASH_KEY.decode(): NO_HASH.decode()})
    put_hash(sink, where=str(path))
    write_whole(path, sink.getvalue())


def read_table(path: Path) -> CheckedTable:
    """Read a table. Whether it has the columns that it should is for the caller to say.

    Raises:
        FileNotFoundError: there is none.
        DamagedFileError: its hash is of other bytes, or it is no table.
        StorageError: it cannot be read now.
    """
    return table_of(read_whole(path), where=str(path))


def table_of(content: bytes, *, where: str) -> CheckedTable:
    """The same for a file's content.

    Raises:
        DamagedFileError: its hash is of other bytes, or it is no table.
    """
    hashes = hashes_of(content)
    check_hash(hashes, {}, where=where)
    try:
        with pq.ParquetFile(pa.BufferReader(content), page_checksum_verification=True) as file:
            # On this thread: one of Arrow's might let go of `content` last, and to do that while
            # the interpreter ends aborts the process.
            table = file.read(use_threads=False)
            table.validate(full=True)
            said = table.schema.metadata or {}
    except Exception as error:  # damaged bytes may cause any error
        raise DamagedFileError(
            f"cannot be read as a table: {' '.join(str(error).split())[:300]}", where=where
        ) from error
    check_hash(hashes, said, where=where)
    return CheckedTable(table, is_proven=hashes is not None)
