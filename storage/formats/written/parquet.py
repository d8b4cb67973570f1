"""Parquet, as a sealed session is, of what was asked for."""

from __future__ import annotations

from collections.abc import Iterator

import pyarrow.parquet as pq

from storage.formats.export import Export
from storage.formats.written.format import TABLE_OPTIONS, Format
from storage.formats.written.sink import in_pieces
from storage.sessions.file import parquet_options


def _write(export: Export) -> Iterator[bytes]:
    return in_pieces(
        export.tables(),
        lambda sink, schema: pq.ParquetWriter(sink, schema, **parquet_options(schema)),
    )


PARQUET = Format(
    "parquet",
    "Parquet",
    "pandas, polars, DuckDB, R",
    "application/vnd.apache.parquet",
    _write,
    options=TABLE_OPTIONS,
    needs_sealed=True,
    is_marked=False,
)
