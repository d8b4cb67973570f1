"""Small Parquet tables with a hash of their bytes, such as markers and clocks of a session.

The hash is in the footer (`storage.parquet_hash`), and every page has a checksum.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from devices.errors import DamagedFileError
from storage.durable_files import read_small_file, write_atomically
from storage.parquet_hash import (
    FILE_HASH_KEY,
    FORMAT,
    FORMAT_KEY,
    HASH_PLACEHOLDER,
    check_file_hash,
    compute_stated_and_actual_hash,
    fill_hash_placeholders,
)


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
    fill_hash_placeholders(sink, where=str(path))
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
    check_file_hash(compute_stated_and_actual_hash(content), where=where)
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
