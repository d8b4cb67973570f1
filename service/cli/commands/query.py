"""`foottile query`: SQL over sealed sessions."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from decimal import Decimal
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from devices.errors import UsageError, escape_control_chars
from service.cli.options import (
    EXIT_INCOMPLETE,
    JsonOption,
    echo,
    print_json,
    remark,
    resolve_data_folder,
    resolve_output_path,
    show_progress,
    stdout,
)

if TYPE_CHECKING:
    import pyarrow as pa


def query_command(
    sql: Annotated[
        str, typer.Argument(help="One SELECT over sessions, stances, markers and frames.")
    ],
    places: Annotated[
        list[str] | None,
        typer.Argument(help="Data folders, folders of sessions, sessions, globs, or URIs (s3://)."),
    ] = None,
    data: Annotated[
        Path | None, typer.Option(help="Data folder, without places; default: the user's.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Parquet file for the result.")] = None,
    as_csv: Annotated[bool, typer.Option("--csv", help="Print the result as CSV.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Run SQL over all sealed sessions.

    Columns and examples are in docs/query.md. Queries are read-only. Sessions that are damaged or
    not yet sealed are left out and named on stderr; then the exit code is 3.
    """
    from service.offline.archive.local_copies import SYSTEM_TEMP_FOLDER, create_workspace
    from service.offline.archive.locations import is_data_folder, is_remote, make_no_session_error
    from service.offline.archive.query import find_sessions, run_query

    if data is not None and places:
        raise UsageError("--data and places exclude each other", remedy="Name one")
    if sum((as_csv, as_json, out is not None)) > 1:
        raise UsageError("--csv, --json and --out exclude each other", remedy="Name one")
    if out is not None and out.suffix != ".parquet":
        raise UsageError(f"--out {str(out)!r}", expected="a name that ends with .parquet")
    path = resolve_output_path(out) if out is not None else None
    locations = places or [str(resolve_data_folder(data))]
    with show_progress("looking for sessions"), ExitStack() as stack:
        needs_mirror = any(is_remote(place) for place in locations)
        mirror = stack.enter_context(create_workspace(SYSTEM_TEMP_FOLDER)) if needs_mirror else None
        archive = find_sessions(locations, mirror)
        is_empty = not archive.sessions and not archive.left_out_reasons
        if is_empty and not any(is_data_folder(place) for place in locations):
            raise make_no_session_error(locations)
        table = run_query(archive, sql)
    if path is not None:
        _write_parquet(table, path)
        echo(f"{path}: {len(table)} rows")
    elif as_json:
        print_json({"rows": _to_rows(table), "left_out": archive.left_out_reasons})
    elif as_csv:
        from storage.formats.writers.tables import write_spreadsheet_safe_csv

        with _explain_unwritable("the answer"):
            write_spreadsheet_safe_csv(sys.stdout.buffer, table)
    else:
        _print_table(table)
    for place, reason in archive.left_out_reasons.items():
        remark(f"{place} is left out: {reason}")
    if archive.left_out_reasons:
        raise typer.Exit(EXIT_INCOMPLETE)


def _to_rows(table: pa.Table) -> list[dict[str, Any]]:
    columns = {name: _to_python(table.column(name), name) for name in table.column_names}
    return [
        {name: _to_json_value(values[row]) for name, values in columns.items()}
        for row in range(len(table))
    ]


def _to_python(column: pa.ChunkedArray[Any], name: str) -> list[Any]:
    """Return a column's values in Python, or as text where Python cannot represent them."""
    import pyarrow as pa

    with _explain_unwritable(name):
        try:
            return column.to_pylist()
        except (ValueError, ArithmeticError):  # a date behind the year 9999
            return column.cast(pa.string()).to_pylist()


@contextmanager
def _explain_unwritable(what: str) -> Iterator[None]:
    """Replace Arrow's error for a value that it cannot write.

    Raises:
        UsageError: in place of Arrow's error.
    """
    import pyarrow as pa

    try:
        yield
    except pa.ArrowException as error:
        raise UsageError(
            f"{what!r} has values that cannot be written here: {error}",
            expected="numbers, text, and dates up to the year 9999",
            remedy="Cast them to VARCHAR in the query, or write them with --out FILE.parquet",
        ) from error


def _to_json_value(value: Any) -> Any:
    """Return a value for JSON; dates and similar types become text."""
    if isinstance(value, list):
        return [_to_json_value(each) for each in value]
    if isinstance(value, dict):
        return {str(name): _to_json_value(each) for name, each in value.items()}
    if isinstance(value, Decimal):
        return int(value) if value == value.to_integral_value() else float(value)
    return value if isinstance(value, str | int | float | None) else str(value)


def _print_table(table: pa.Table) -> None:
    from rich.markup import escape
    from rich.table import Table

    grid = Table(box=None, pad_edge=False)
    rows = _to_rows(table)
    for name in table.column_names:
        is_number = all(isinstance(row[name], int | float | None) for row in rows)
        justify: Any = "right" if is_number else "left"
        # A row is one line: a wrapped text could look like another row.
        grid.add_column(escape(escape_control_chars(name)), justify=justify, no_wrap=True)
    for row in rows:
        grid.add_row(
            *(escape(escape_control_chars(_format_value(value))) for value in row.values())
        )
    stdout.print(grid)


def _format_value(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _write_parquet(table: pa.Table, path: Path) -> None:
    import pyarrow.parquet as pq

    from storage.durable_files import open_for_atomic_write

    with open_for_atomic_write(path) as file, _explain_unwritable("the answer"):
        pq.write_table(table, file, compression="zstd")
