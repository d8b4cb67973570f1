"""Reader of Parquet files of other programs or of exported FootTile sessions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from devices.errors import FileFormatError
from devices.inputs import check_file
from storage.file_hash import check_hash, file_hashes
from storage.formats.tables.table import (
    INSTANTS,
    Column,
    IsNeeded,
    Table,
    check_size,
    make_table,
    needed_names,
)
from storage.formats.tables.text import as_floats


def read_parquet(path: Path, is_needed: IsNeeded, numbers_max: int) -> Table:
    """Read a Parquet file.

    Raises:
        FileFormatError: the file cannot be read, is too large, or a needed column is not numeric.
        DamagedFileError: the file is a session whose bytes differ from the sealed ones.
    """
    where = str(path)
    try:
        check_file(path)
        with pq.ParquetFile(path, page_checksum_verification=True) as file:
            schema = file.schema_arrow
            check_hash(file_hashes(path), schema.metadata or {}, where=where)
            needed = needed_names(schema.names, is_needed, where)
            check_size(file.metadata.num_rows, len(needed), numbers_max, where)
            table = file.read(columns=needed)
    except (OSError, pa.ArrowException, UnicodeDecodeError) as error:
        raise FileFormatError(
            f"cannot be read: {error}", where=where, expected="a Parquet file"
        ) from error
    columns = {name: _numbers(table[name], name, where) for name in needed}
    return make_table(where, schema.names, columns, schema=schema)


def _numbers(cells: pa.ChunkedArray[Any], name: str, where: str) -> Column:
    if name.lower() == INSTANTS and pa.types.is_integer(cells.type) and not cells.null_count:
        return np.asarray(cells.to_numpy(), dtype=np.int64)
    try:
        return as_floats(cells.cast(pa.float64()).combine_chunks())
    except pa.ArrowException as error:
        raise FileFormatError(f"column {name} is not numeric: {error}", where=where) from error
