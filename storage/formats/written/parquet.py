"""Parquet writer for readers of the last five years.

Pages are plain or dictionary-encoded. A sealed file is smaller, and needs newer readers: see
docs/formats.md.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from storage.formats.export import Export
from storage.formats.written.format import TABLE_OPTIONS, Format
from storage.formats.written.sink import in_pieces
from storage.sessions.file import parquet_options


def _write(export: Export) -> Iterator[bytes]:
    return in_pieces(
        export.tables(),
        lambda sink, schema: pq.ParquetWriter(sink, schema, **_options(schema)),
    )


def _options(schema: pa.Schema) -> dict[str, Any]:
    return {**parquet_options(schema), "column_encoding": None}


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
