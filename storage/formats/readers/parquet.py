"""Reader of Parquet files of other programs or of exported FootTile sessions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from devices.errors import FileFormatError
from devices.input_files import check_regular_file
from storage.formats.readers.table import (
    INSTANT_COLUMN,
    Column,
    ColumnFilter,
    ForceTable,
    check_table_size,
    make_table_with_standard_names,
    select_needed_names,
)
from storage.formats.readers.text import arrow_to_floats
from storage.parquet_hash import FORMAT_KEY, check_file_hash, read_stated_and_actual_hash


def read_parquet_table(path: Path, is_needed: ColumnFilter, values_max: int) -> ForceTable:
    """Read the needed columns of a Parquet file; verify the hash of a FootTile session.

    Raises:
        FileFormatError: the file cannot be read, is too large, or a needed column is not numeric.
        DamagedFileError: the file is a session whose bytes differ from the sealed ones.
    """
    where = str(path)
    try:
        check_regular_file(path)
        with pq.ParquetFile(path, page_checksum_verification=True) as file:
            schema = file.schema_arrow
            hashes = read_stated_and_actual_hash(path)
            if hashes is not None or FORMAT_KEY in (schema.metadata or {}):
                check_file_hash(hashes, where=where)
            needed = select_needed_names(schema.names, is_needed, where)
            check_table_size(file.metadata.num_rows, len(needed), values_max, where)
            table = file.read(columns=needed)
    except (OSError, pa.ArrowException, UnicodeDecodeError) as error:
        raise FileFormatError(
            f"cannot be read: {error}", where=where, expected="a Parquet file"
        ) from error
    columns = {name: _to_numbers(table[name], name, where) for name in needed}
    return make_table_with_standard_names(where, schema.names, columns, schema=schema)


def _to_numbers(cells: pa.ChunkedArray[Any], name: str, where: str) -> Column:
    if name.lower() == INSTANT_COLUMN and pa.types.is_integer(cells.type) and not cells.null_count:
        return np.asarray(cells.to_numpy(), dtype=np.int64)
    try:
        return arrow_to_floats(cells.cast(pa.float64()).combine_chunks())
    except pa.ArrowException as error:
        raise FileFormatError(f"column {name} is not numeric: {error}", where=where) from error
