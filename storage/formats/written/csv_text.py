"""CSV writer that escapes text which spreadsheets would run as formulas.

CSV has no metadata: the first cell of the column `about` has them as JSON, its other cells are
empty. Every reader of tables accepts this.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any, BinaryIO

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as pacsv

from storage.formats.export import Export
from storage.formats.written.format import TABLE_OPTIONS, Format
from storage.formats.written.sink import in_pieces
from storage.sessions.file import EXPORT_COLUMN

_FORMULA = r"^([=+\-@'\t\r\n\x{ff0b}\x{ff0d}\x{ff1d}\x{ff20}])"
"""Pattern of the beginning of a spreadsheet's formula, and of the apostrophe that escapes it."""


def write_csv(sink: BinaryIO, table: pa.Table) -> None:
    """Write a table as CSV, with text escaped against spreadsheets' formulas."""
    with _Writer(sink, table.schema) as writer:
        writer.write_table(table)


class _Writer(pacsv.CSVWriter):
    """CSV writer that puts an apostrophe before text that begins like a formula or with one."""

    def write_table(self, table: pa.Table, max_chunksize: int | None = None) -> None:
        """Append rows."""
        super().write_table(_without_formulas(table), max_chunksize)


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
        for batch in _without_formulas(table).to_batches():
            cells = [_cells(column) for column in batch.columns]
            lines = _joined(*cells, between=";")
            self._sink.write("".join(f"{line}\n" for line in lines.to_pylist()).encode())

    def close(self) -> None:
        """Return at once: all rows are written already."""


def _cells(column: pa.Array[Any]) -> pa.Array[Any]:
    if pa.types.is_string(column.type):
        text = pc.replace_substring(column, '"', '""')
        quoted: pa.Array[Any] = pc.if_else(
            pc.is_null(text), text, _joined('"', text, '"', between="")
        )
        return quoted
    text = column.cast(pa.string())
    is_real = pa.types.is_floating(column.type)
    return pc.replace_substring(text, ".", ",") if is_real else text


def _joined(*texts: pa.Array[Any] | str, between: str) -> pa.Array[Any]:
    join: Any = pc.binary_join_element_wise  # its stubs know no mixture
    joined: pa.Array[Any] = join(*texts, between, null_handling="replace", null_replacement="")
    return joined


def _without_formulas(table: pa.Table) -> pa.Table:
    for i, field in enumerate(table.schema):
        if pa.types.is_string(field.type):
            text = pc.replace_substring_regex(table.column(i), _FORMULA, r"'\1")
            table = table.set_column(i, field, text)
    return table


def _with_about(tables: Iterator[pa.Table], about: str) -> Iterator[pa.Table]:
    """Append a column that has `about` in the first row of the first table, else null."""
    for table in tables:
        cells = pa.nulls(len(table), pa.string())
        if about and len(table):
            cells = pa.concat_arrays([pa.array([about]), cells[1:]])
            about = ""
        yield table.append_column(EXPORT_COLUMN, cells)


def _write(export: Export) -> Iterator[bytes]:
    opened = _CommaWriter if export.options.decimal == "comma" else _Writer
    tables, has_about = export.tables(), export.options.about
    if has_about or (has_about is None and not export.part.columns):
        tables = _with_about(tables, json.dumps(export.about))
    return in_pieces(tables, opened)


CSV = Format(
    "csv",
    "CSV",
    "spreadsheets, MATLAB, R",
    "text/csv; charset=utf-8; header=present",
    _write,
    options=(*TABLE_OPTIONS, "decimal", "about"),
)
