"""Arrow writer: an IPC file of record batches (Feather version 2), without compression."""

from __future__ import annotations

from collections.abc import Iterator

import pyarrow as pa

from storage.formats.export import Export
from storage.formats.writers.drained_buffer import encode_tables
from storage.formats.writers.format import TABLE_OPTIONS, ExportFormat


def _encode(export: Export) -> Iterator[bytes]:
    return encode_tables(export.read_tables(), pa.ipc.new_file)


ARROW = ExportFormat(
    "arrow",
    "Arrow",
    "pandas, polars, DuckDB, R",
    "application/vnd.apache.arrow.file",
    _encode,
    options=TABLE_OPTIONS,
)
