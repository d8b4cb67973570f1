"""Reader of manifests: CSV files with one row per session."""

from __future__ import annotations

import codecs
import csv
import re
from collections.abc import Collection, Iterator
from itertools import islice
from pathlib import Path
from typing import TextIO

from devices.errors import FileFormatError, UsageError
from devices.input_files import check_regular_file
from service.offline.archive.locations import is_remote, make_absolute

_MAX_HEADER_LINE = 20
"""Number of lines that are searched for the column names."""
_DELIMITER_LINE = re.compile(r"(?i)sep=(.)")
"""Excel's line that states the delimiter."""
_PIECE = 1 << 20
_MAX_LINE_CHARS = 1 << 16
"""Longest accepted line, in characters; it bounds the memory for files that are no table."""
_MAX_FILE_BYTES = 64 << 20
"""Largest manifest, some 600,000 sessions: detecting the encoding reads the whole file."""


def read_rows(path: Path, allowed_columns: Collection[str]) -> Iterator[dict[str, str]]:
    """Yield rows by the names of their columns; paths of sessions are relative to the manifest.

    Cells are parted by commas, semicolons or tabs, as spreadsheets save them; empty rows, and
    columns without name and content, are left out.

    Args:
        path: the file.
        allowed_columns: allowed columns; `session` is required.

    Raises:
        UsageError: it cannot be read, or has other columns; raised before the first row.
        FileFormatError: a row has no session, or more or fewer cells than there are columns.
    """
    try:
        check_regular_file(path, bytes_max=_MAX_FILE_BYTES)
        encoding = _detect_encoding(path)
        with path.open(encoding=encoding, newline="") as file:
            head = list(islice(_read_lines(file), _MAX_HEADER_LINE))
    except (OSError, UnicodeError, csv.Error) as error:
        raise UsageError(f"--manifest {str(path)!r} cannot be read: {error}") from error
    if any("\0" in line for line in head):
        raise UsageError(f"--manifest {str(path)!r} is not a text file")
    at = next((i for i, line in enumerate(head) if line.strip(" ,;\t\r\n")), 0)
    stated = _DELIMITER_LINE.fullmatch(head[at].strip()) if head else None
    delimiters = stated[1] if stated else ",;\t"
    names = "".join(head[at + bool(stated) :][:1])
    found = {
        one: _strip_trailing_cells(next(csv.reader([names], delimiter=one), []))
        for one in delimiters
    }
    delimiter = max(found, key=lambda one: ("session" in found[one], len(found[one])))
    columns = found[delimiter]
    if (
        "session" not in columns
        or set(columns) - set(allowed_columns)
        or len(set(columns)) < len(columns)
    ):
        raise UsageError(
            f"--manifest {str(path)!r} has the columns {', '.join(columns)[:200] or 'of nothing'}",
            expected=f"session, and of {', '.join(sorted(allowed_columns))} those that differ by "
            "row",
        )
    return _read_data_rows(path, columns, encoding, delimiter, at + bool(stated))


def resolve_path(manifest_path: Path, session_path: str) -> str:
    """Resolve a path of a manifest: relative to the manifest's folder, unless it is a URI."""
    return (
        session_path
        if is_remote(session_path)
        else make_absolute(str(manifest_path.parent / session_path))
    )


def _read_data_rows(
    path: Path, columns: list[str], encoding: str, delimiter: str, begin: int
) -> Iterator[dict[str, str]]:
    """Yield the rows below the column names, which are in line `begin`, counted from 0."""
    with path.open(encoding=encoding, newline="") as file:
        try:
            lines = islice(_read_lines(file), begin, None)
            for number, row in enumerate(csv.reader(lines, delimiter=delimiter), start=begin + 1):
                cells = _strip_trailing_cells(row)
                if number == begin + 1 or not cells:
                    continue
                cells += [""] * (min(len(row), len(columns)) - len(cells))
                named = dict(zip(columns, cells, strict=False))
                if len(cells) != len(columns) or not named["session"]:
                    raise FileFormatError(
                        f"row {number} has {len(cells)} cells",
                        where=str(path),
                        expected=f"{len(columns)}, with a session",
                    )
                yield {**named, "session": resolve_path(path, named["session"])}
        except (UnicodeError, csv.Error) as error:
            raise FileFormatError(f"cannot be read: {error}", where=str(path)) from error


def _strip_trailing_cells(row: list[str]) -> list[str]:
    """Return the cells of a row without empty ones at its end."""
    cells = [cell.strip() for cell in row]
    while cells and not cells[-1]:
        cells.pop()
    return cells


def _detect_encoding(path: Path) -> str:
    """Return the encoding that a spreadsheet has saved a text in."""
    check = codecs.getincrementaldecoder("utf-8")()
    with path.open("rb") as file:
        if file.read(2) in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE):
            return "utf-16"
        file.seek(0)
        try:
            while piece := file.read(_PIECE):
                check.decode(piece)
            check.decode(b"", final=True)
        except UnicodeDecodeError:
            return "cp1252"
    return "utf-8-sig"


def _read_lines(file: TextIO) -> Iterator[str]:
    while line := file.readline(_MAX_LINE_CHARS):
        if len(line) == _MAX_LINE_CHARS:
            raise csv.Error(f"a line is longer than {_MAX_LINE_CHARS} characters")
        yield line
