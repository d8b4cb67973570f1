"""Arrow: a stream of record batches, without compression."""

from __future__ import annotations

from collections.abc import Iterator

import pyarrow as pa

from storage.formats.export import Export
from storage.formats.written.format import TABLE_OPTIONS, Format
from storage.formats.written.sink import in_pieces


def _write(export: Export) -> Iterator[bytes]:
    return in_pieces(export.tables(), pa.ipc.new_stream)


ARROW = Format(
    "arrow",
    "Arrow",
    "pandas, polars, DuckDB, R",
    "application/vnd.apache.arrow.stream",
    _write,
    options=TABLE_OPTIONS,
)
