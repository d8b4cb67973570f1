"""A manifest: a CSV file with a row for each session, read row by row."""

from __future__ import annotations

import csv
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import TextIO

from devices.errors import FileFormatError, UsageError
from devices.inputs import check_file
from service.offline.archive.places import absolute, is_remote

_LINE_MAX = 1 << 16
"""A longer line is none of a table: no file is read into memory for it."""


def rows_in(path: Path, known: Collection[str]) -> Iterator[dict[str, str]]:
    """Rows by the names of their columns; paths of sessions are relative to the manifest.

    Args:
        path: the file.
        known: columns that it may have; `session` it must.

    Raises:
        UsageError: it cannot be read, or has other columns; said before the first row is given.
        FileFormatError: a row has no session, or more or fewer cells than there are columns.
    """
    try:
        check_file(path)
        with path.open(encoding="utf-8-sig", newline="") as file:
            columns = next(csv.reader(_lines(file)), [])
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise UsageError(f"--manifest {str(path)!r} cannot be read: {error}") from error
    if "session" not in columns or set(columns) - set(known) or len(set(columns)) < len(columns):
        raise UsageError(
            f"--manifest {str(path)!r} has the columns {', '.join(columns)[:200] or 'of nothing'}",
            expected=f"session, and of {', '.join(sorted(known))} those that differ by row",
        )
    return _rows(path, columns)


def resolved(path: Path, named: str) -> str:
    """A path in a manifest: relative to the manifest's folder, unless it is a URI."""
    return named if is_remote(named) else absolute(str(path.parent / named))


def _rows(path: Path, columns: list[str]) -> Iterator[dict[str, str]]:
    with path.open(encoding="utf-8-sig", newline="") as file:
        try:
            for number, cells in enumerate(csv.reader(_lines(file)), start=1):
                if number == 1 or not cells:
                    continue
                row = dict(zip(columns, (cell.strip() for cell in cells), strict=False))
                if len(cells) != len(columns) or not row["session"]:
                    raise FileFormatError(
                        f"row {number} has {len(cells)} cells",
                        where=str(path),
                        expected=f"{len(columns)}, with a session",
                    )
                yield {**row, "session": resolved(path, row["session"])}
        except (UnicodeDecodeError, csv.Error) as error:
            raise FileFormatError(f"cannot be read: {error}", where=str(path)) from error


def _lines(file: TextIO) -> Iterator[str]:
    while line := file.readline(_LINE_MAX):
        if len(line) == _LINE_MAX:
            raise csv.Error(f"a line is longer than {_LINE_MAX} characters")
        yield line
