"""Writers of tables: Arrow, Parquet, and CSV that no spreadsheet runs as formulas.

Pages are plain or dictionary-encoded. A sealed file is smaller, and needs newer readers: see
docs/formats.md.

CSV has no metadata: the first cell of the column `about` has them as JSON, its other cells are
empty. Every reader of tables accepts this.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from typing import Any, BinaryIO

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as pacsv
import pyarrow.parquet as pq

from storage.formats.export import Export
from storage.formats.writers.format import TABLE_OPTIONS, ExportFormat, encode_tables
from storage.sessions.writer import EXPORT_COLUMN, parquet_options


def _encode_arrow(exports: Sequence[Export]) -> Iterator[bytes]:
    (export,) = exports
    return encode_tables(export.read_tables(), pa.ipc.new_file)


ARROW = ExportFormat(
    "arrow",
    "Arrow",
    "pandas, polars, DuckDB, R",
    "application/vnd.apache.arrow.file",
    _encode_arrow,
    options=TABLE_OPTIONS,
)


def _encode_parquet(exports: Sequence[Export]) -> Iterator[bytes]:
    (export,) = exports

    def open_writer(sink: BinaryIO, schema: pa.Schema) -> pq.ParquetWriter:
        options: dict[str, Any] = {**parquet_options(schema), "column_encoding": None}
        return pq.ParquetWriter(sink, schema, **options)

    return encode_tables(export.read_tables(), open_writer)


PARQUET = ExportFormat(
    "parquet",
    "Parquet",
    "pandas, polars, DuckDB, R",
    "application/vnd.apache.parquet",
    _encode_parquet,
    options=TABLE_OPTIONS,
    needs_sealed=True,
    has_markers_by_default=False,
)


_FORMULA_START = r"^([=+\-@'\t\r\n\x{ff0b}\x{ff0d}\x{ff1d}\x{ff20}])"
"""Pattern of the beginning of a spreadsheet's formula, and of the apostrophe that escapes it."""


def write_spreadsheet_safe_csv(sink: BinaryIO, table: pa.Table) -> None:
    """Write a table as CSV, with text escaped against spreadsheets' formulas."""
    with _EscapingWriter(sink, table.schema) as writer:
        writer.write_table(table)


class _EscapingWriter(pacsv.CSVWriter):
    """CSV writer that puts an apostrophe before text that begins like a formula or with one."""

    def write_table(self, table: pa.Table, max_chunksize: int | None = None) -> None:
        """Append rows."""
        super().write_table(_escape_formulas(table), max_chunksize)


class _CommaWriter:
    """Writer for Excel where numbers have a decimal comma, with semicolons between columns.

    Without a byte order mark Excel decodes the text as Windows-1252.
    """

    def __init__(self, sink: BinaryIO, schema: pa.Schema) -> None:
        self._sink = sink
        names = (name.replace('"', '""') for name in schema.names)
        self._sink.write((";".join(f'"{name}"' for name in names) + "\n").encode("utf-8-sig"))

    def write_table(self, table: pa.Table) -> None:
        """Append rows."""
        for batch in _escape_formulas(table).to_batches():
            cells = [_format_cells(column) for column in batch.columns]
            lines = _join_texts(*cells, separator=";")
            self._sink.write("".join(f"{line}\n" for line in lines.to_pylist()).encode())

    def close(self) -> None:
        """Return at once: all rows are written already."""


def _format_cells(column: pa.Array[Any]) -> pa.Array[Any]:
    if pa.types.is_string(column.type):
        text = pc.replace_substring(column, '"', '""')
        quoted: pa.Array[Any] = pc.if_else(
            pc.is_null(text), text, _join_texts('"', text, '"', separator="")
        )
        return quoted
    text = column.cast(pa.string())
    is_real = pa.types.is_floating(column.type)
    return pc.replace_substring(text, ".", ",") if is_real else text


def _join_texts(*texts: pa.Array[Any] | str, separator: str) -> pa.Array[Any]:
    join: Any = pc.binary_join_element_wise  # its stubs know no mixture
    joined: pa.Array[Any] = join(*texts, separator, null_handling="replace", null_replacement="")
    return joined


def _escape_formulas(table: pa.Table) -> pa.Table:
    for i, field in enumerate(table.schema):
        if pa.types.is_string(field.type):
            text = pc.replace_substring_regex(table.column(i), _FORMULA_START, r"'\1")
            table = table.set_column(i, field, text)
    return table


def _append_about_column(tables: Iterator[pa.Table], about: str) -> Iterator[pa.Table]:
    """Append a column that has `about` in the first row of the first table, else null."""
    for table in tables:
        cells = pa.nulls(len(table), pa.string())
        if about and len(table):
            cells = pa.concat_arrays([pa.array([about]), cells[1:]])
            about = ""
        yield table.append_column(EXPORT_COLUMN, cells)


def _encode_csv(exports: Sequence[Export]) -> Iterator[bytes]:
    (export,) = exports
    opened = _CommaWriter if export.options.decimal == "comma" else _EscapingWriter
    tables, has_about = export.read_tables(), export.options.about
    if has_about or (has_about is None and not export.selection.columns):
        tables = _append_about_column(tables, json.dumps(export.provenance_and_slice_metadata))
    return encode_tables(tables, opened)


CSV = ExportFormat(
    "csv",
    "CSV",
    "spreadsheets, MATLAB, R",
    "text/csv; charset=utf-8; header=present",
    _encode_csv,
    options=(*TABLE_OPTIONS, "decimal", "about"),
)
