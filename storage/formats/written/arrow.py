"""Arrow writer: an IPC file of record batches (Feather version 2), without compression."""

from __future__ import annotations

from collections.abc import Iterator

import pyarrow as pa

from storage.formats.export import Export
from storage.formats.written.format import TABLE_OPTIONS, Format
from storage.formats.written.sink import in_pieces


def _write(export: Export) -> Iterator[bytes]:
    return in_pieces(export.tables(), pa.ipc.new_file)


ARROW = Format(
    "arrow",
    "Arrow",
    "pandas, polars, DuckDB, R",
    "application/vnd.apache.arrow.file",
    _write,
    options=TABLE_OPTIONS,
)
