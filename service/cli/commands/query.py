"""`foottile query`: SQL over many sessions."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from decimal import Decimal
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from devices.errors import UsageError
from devices.text import escape_control_chars
from service.cli.options import (
    JsonOption,
    data_folder,
    output_path,
    print_json,
    progress,
    remark,
    say,
    stdout,
)

if TYPE_CHECKING:
    import pyarrow as pa

_LEFT_OUT = 3


def query_command(
    sql: Annotated[
        str, typer.Argument(help="One SELECT over sessions, stances, markers and frames.")
    ],
    places: Annotated[
        list[str] | None,
        typer.Argument(
            help="Data folders, folders of sessions, sessions, globs of these, or URIs as s3://."
        ),
    ] = None,
    data: Annotated[
        Path | None, typer.Option(help="Data folder, if no place is named; default: the user's.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Parquet file to write the answer to.")] = None,
    as_csv: Annotated[bool, typer.Option("--csv", help="Print the answer as CSV.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Run SQL over all sealed sessions.

    Columns and examples are in docs/query.md. No question changes a session. Sessions that are not
    sealed yet, or damaged, are left out and named on stderr; the exit code is 3 then.
    """
    from service.offline.archive.locations import is_data_folder, is_remote, make_no_session_error
    from service.offline.archive.query import run_query
    from service.offline.archive.session_search import find_sessions
    from service.offline.archive.temporary_folders import SYSTEM_TEMP_FOLDER, create_workspace

    if data is not None and places:
        raise UsageError("--data and places are two ways to say where", remedy="Name one")
    if sum((as_csv, as_json, out is not None)) > 1:
        raise UsageError("--csv, --json and --out are three forms of one answer", remedy="Name one")
    if out is not None and out.suffix != ".parquet":
        raise UsageError(f"--out {str(out)!r}", expected="a name that ends with .parquet")
    path = output_path(out) if out is not None else None
    asked = places or [str(data_folder(data))]
    with progress("looking for sessions"), ExitStack() as stack:
        needs_mirror = any(is_remote(place) for place in asked)
        mirror = stack.enter_context(create_workspace(SYSTEM_TEMP_FOLDER)) if needs_mirror else None
        archive = find_sessions(asked, mirror)
        is_empty = not archive.sessions and not archive.left_out_reasons
        if is_empty and not any(is_data_folder(place) for place in asked):
            raise make_no_session_error(asked)
        answer = run_query(archive, sql)
    if path is not None:
        _write(answer, path)
        say(f"{path}: {len(answer)} rows")
    elif as_json:
        print_json({"rows": _rows(answer), "left_out": archive.left_out_reasons})
    elif as_csv:
        from storage.formats.writers.csv_text import write_csv_table

        with _unwritable("the answer"):
            write_csv_table(sys.stdout.buffer, answer)
    else:
        _print(answer)
    for place, reason in archive.left_out_reasons.items():
        remark(f"{place} is left out: {reason}")
    if archive.left_out_reasons:
        raise typer.Exit(_LEFT_OUT)


def _rows(answer: pa.Table) -> list[dict[str, Any]]:
    columns = {name: _values(answer.column(name), name) for name in answer.column_names}
    return [
        {name: _value(values[row]) for name, values in columns.items()}
        for row in range(len(answer))
    ]


def _values(column: pa.ChunkedArray[Any], name: str) -> list[Any]:
    """Return a column as Python has it, or as text where Python has no such value."""
    import pyarrow as pa

    with _unwritable(name):
        try:
            return column.to_pylist()
        except (ValueError, ArithmeticError):  # a date behind the year 9999
            return column.cast(pa.string()).to_pylist()


@contextmanager
def _unwritable(what: str) -> Iterator[None]:
    """Turn what Arrow cannot write into an error with a way out.

    Raises:
        UsageError: in place of Arrow's.
    """
    import pyarrow as pa

    try:
        yield
    except pa.ArrowException as error:
        raise UsageError(
            f"{what!r} has values that cannot be written here: {error}",
            expected="numbers, text, and dates up to the year 9999",
            remedy="Cast them to VARCHAR in the question, or write them with --out FILE.parquet",
        ) from error


def _value(value: Any) -> Any:
    """As JSON can hold it; dates and the like as text."""
    if isinstance(value, list):
        return [_value(each) for each in value]
    if isinstance(value, dict):
        return {str(name): _value(each) for name, each in value.items()}
    if isinstance(value, Decimal):
        return int(value) if value == value.to_integral_value() else float(value)
    return value if isinstance(value, str | int | float | None) else str(value)


def _print(answer: pa.Table) -> None:
    from rich.markup import escape
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    rows = _rows(answer)
    for name in answer.column_names:
        is_number = all(isinstance(row[name], int | float | None) for row in rows)
        justify: Any = "right" if is_number else "left"
        # A row is one line: a text that goes on in the next could look like a line of ours.
        table.add_column(escape(escape_control_chars(name)), justify=justify, no_wrap=True)
    for row in rows:
        table.add_row(*(escape(escape_control_chars(_text(value))) for value in row.values()))
    stdout.print(table)


def _text(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _write(answer: pa.Table, path: Path) -> None:
    import pyarrow.parquet as pq

    from storage.durable_files import open_for_atomic_write

    with open_for_atomic_write(path) as file, _unwritable("the answer"):
        pq.write_table(answer, file, compression="zstd")
