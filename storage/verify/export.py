"""Recognition of exports: files made from a session, which prove nothing themselves."""

from __future__ import annotations

import csv
import json
import os
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from storage.schema import COLUMNS_BY_NAME
from storage.sessions.writer import EXPORT_COLUMN, EXPORT_KEY

RECOGNISED_FORMATS = frozenset({"parquet", "arrow", "csv"})
"""Export formats that are recognised."""
_ARROW_BEGIN = b"ARROW1\0\0"
_HEADER_MAX = 1 << 20
_SEMICOLONS = re.compile(r'"[^";,]*";')
_TILE_COLUMN = re.compile("|".join(f"{c.name}_." for c in COLUMNS_BY_NAME.values() if c.per_tile))
"""Column of one tile: the quantity, then number or serial."""


@dataclass
class ExportReport:
    """Facts about an export.

    Attributes:
        path: the file.
        format: format of the file.
        source: session, hashes of its file, and selection; empty if the export has none of it.
        problems: messages of damage; empty: it can be read to its end.
    """

    path: Path
    format: str
    source: dict[str, Any] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)

    def to_json_dict(self) -> dict[str, Any]:
        """Return the report for JSON (docs/formats.md)."""
        return {
            "export": self.format,
            "source": self.source,
            "proves": [],
            "problems": self.problems,
        }


def recognise_export_and_check_not_cut_off(path: Path) -> ExportReport | None:
    """Recognise an export; read Parquet and Arrow to their end, and both ends of CSV.

    Returns:
        None if it is no export: a sealed session, another file, or too damaged to tell.
    """
    with path.open("rb") as file:
        begin = file.read(4)
    if begin == b"PAR1":
        return _read_parquet_export(path)
    if begin == _ARROW_BEGIN[:4]:
        return _read_arrow_export(path)
    return _read_csv_export(path)


def _read_parquet_export(path: Path) -> ExportReport | None:
    try:
        file = pq.ParquetFile(path, page_checksum_verification=True)
        metadata = file.schema_arrow.metadata or {}
    except Exception:  # damaged bytes may cause any error
        return None
    with file:
        if EXPORT_KEY not in metadata:
            return None
        report = ExportReport(path, "parquet", _parse_source(metadata))
        try:
            for group in range(file.num_row_groups):
                file.read_row_group(group)
        except Exception as error:  # damaged bytes may cause any error
            report.problems.append(f"it cannot be read: {error}")
    return report


def _read_arrow_export(path: Path) -> ExportReport | None:
    try:
        with pa.OSFile(str(path), "r") as file:
            file.seek(len(_ARROW_BEGIN))  # a stream begins there, which needs no footer
            with pa.ipc.open_stream(file) as stream:
                metadata = stream.schema.metadata or {}
            if EXPORT_KEY not in metadata:
                return None
            report = ExportReport(path, "arrow", _parse_source(metadata))
            try:
                with pa.ipc.open_file(file) as whole:
                    for i in range(whole.num_record_batches):
                        whole.get_batch(i).validate()
            except Exception as error:  # damaged bytes may cause any error
                report.problems.append(f"it cannot be read: {error}")
    except Exception:  # damaged bytes may cause any error
        return None
    return report


def _read_csv_export(path: Path) -> ExportReport | None:
    with path.open("rb") as file:
        lines = [file.readline(_HEADER_MAX) for _ in range(2)]
    try:
        header, row = (line.decode("utf-8").rstrip("\r\n") for line in lines)
        between = ";" if _SEMICOLONS.match(header) else ","
        names, *cells = csv.reader([header, row] if row else [header], delimiter=between)
    except (UnicodeDecodeError, ValueError, csv.Error):
        return None
    known_names = {*COLUMNS_BY_NAME, EXPORT_COLUMN}
    if not names or not all(name in known_names or _TILE_COLUMN.match(name) for name in names):
        return None
    first = dict(zip(names, *cells, strict=False)) if cells else {}
    report = ExportReport(path, "csv", _parse_json_object(first.get(EXPORT_COLUMN, "")))
    with path.open("rb") as file:
        file.seek(-1, os.SEEK_END)
        if file.read() != b"\n":
            report.problems.append("its last row is cut off; export it again")
    return report


def _parse_source(metadata: dict[bytes, bytes]) -> dict[str, Any]:
    return _parse_json_object(metadata.get(EXPORT_KEY, b""))


def _parse_json_object(text: str | bytes) -> dict[str, Any]:
    try:
        source = json.loads(text)
    except ValueError:
        return {}
    return source if isinstance(source, dict) else {}
