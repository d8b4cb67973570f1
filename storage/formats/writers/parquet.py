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
from storage.formats.writers.drained_buffer import encode_tables
from storage.formats.writers.format import TABLE_OPTIONS, ExportFormat
from storage.sessions.writer import parquet_options


def _encode(export: Export) -> Iterator[bytes]:
    return encode_tables(
        export.read_tables(),
        lambda sink, schema: pq.ParquetWriter(sink, schema, **_options(schema)),
    )


def _options(schema: pa.Schema) -> dict[str, Any]:
    return {**parquet_options(schema), "column_encoding": None}


PARQUET = ExportFormat(
    "parquet",
    "Parquet",
    "pandas, polars, DuckDB, R",
    "application/vnd.apache.parquet",
    _encode,
    options=TABLE_OPTIONS,
    needs_sealed=True,
    has_markers_by_default=False,
)
