"""Questions about many sessions in SQL, answered by DuckDB from what is handed to it.

DuckDB itself opens no file and no connection: tables and frames are given to it through Arrow, and
everything else that it could reach is locked before the first question is read.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import pyarrow as pa

from devices.errors import FileFormatError, UsageError, needs_extra

if TYPE_CHECKING:
    import duckdb

    from service.offline.archive.sealed import Archive

VIEWS = ("sessions", "stances", "events", "frames")
LOCKED: dict[str, Any] = {
    "enable_external_access": False,  # no file is read or written, nothing attached or loaded
    "autoinstall_known_extensions": False,
    "autoload_known_extensions": False,
    "allow_community_extensions": False,
    "python_enable_replacements": False,  # a name is a view, and no variable of this program
    "temp_directory": "",
    # Half of the machine's: a question that needs more is refused. DuckDB takes no "50%" up to 1.5.
    "memory_limit": f"{os.sysconf('SC_PAGE_SIZE') * os.sysconf('SC_PHYS_PAGES') // 2}B",
    "lock_configuration": True,
}


def ask(archive: Archive, sql: str) -> pa.Table:
    """The answer to one SELECT.

    Args:
        archive: the sessions; what of them turns out to be damaged is left out, and noted there.
        sql: over the views `VIEWS`, which are made only if they are named in it.

    Raises:
        MissingExtraError: DuckDB is not installed.
        UsageError: it is not one SELECT, names what is not there, or asks for what is locked.
        FileFormatError: frames that it reads are damaged.
    """
    with needs_extra("archive", "`foottile query`"):
        import duckdb
    with duckdb.connect(":memory:", config=LOCKED) as connection:
        try:
            _check(connection, sql)
            makers: dict[str, Callable[[], Any]] = {
                "frames": archive.frames,
                "stances": archive.stances_table,
                "events": archive.events_table,
                "sessions": archive.sessions_table,  # last, without those found damaged by then
            }
            asked = _views_in(connection, sql)
            for name, make in makers.items():
                if name in asked:
                    connection.register(name, make())
            return _plain(_without_intervals(connection.sql(sql)).to_arrow_table())
        except (duckdb.Error, pa.ArrowException) as error:
            raise _explained(error) from error


def _check(connection: duckdb.DuckDBPyConnection, sql: str) -> None:
    kinds = [statement.type.name for statement in connection.extract_statements(sql)]
    if kinds not in (["SELECT"], ["EXPLAIN"]):
        raise UsageError(
            f"the question is {' and '.join(kinds) or 'empty'}",
            expected="one SELECT over " + ", ".join(VIEWS),
        )


def _views_in(connection: duckdb.DuckDBPyConnection, sql: str) -> set[str]:
    """Which views a question is about: of the others nothing is read."""
    mentioned = {name for name in VIEWS if re.search(rf"\b{name}\b", sql, re.IGNORECASE)}
    found = connection.execute("SELECT json_serialize_sql(?::VARCHAR)", [sql]).fetchall()
    tree = json.loads(found[0][0])
    if tree["error"]:  # it does not say, as of an EXPLAIN
        return mentioned
    return {name for name in _tables_in(tree) if name in mentioned}


def _tables_in(node: Any) -> Iterator[str]:
    if isinstance(node, dict):
        if isinstance(name := node.get("table_name"), str):
            yield name.lower()
        node = list(node.values())
    if isinstance(node, list):
        for each in node:
            yield from _tables_in(each)


def _without_intervals(answer: duckdb.DuckDBPyRelation) -> duckdb.DuckDBPyRelation:
    """Return the answer with intervals as text: of months neither CSV, Parquet nor JSON has any."""
    if not any("INTERVAL" in str(kind) for kind in answer.types):
        return answer
    names = [f'"{name.replace(chr(34), chr(34) * 2)}"' for name in answer.columns]
    return answer.project(
        ", ".join(
            f"CAST({name} AS VARCHAR) AS {name}" if "INTERVAL" in str(kind) else name
            for name, kind in zip(names, answer.types, strict=True)
        )
    )


def _plain(table: pa.Table) -> pa.Table:
    """Sums of integers as int64: DuckDB makes them decimals of 38 digits."""
    if len(set(table.column_names)) < len(table.column_names):
        twice = next(n for n in table.column_names if table.column_names.count(n) > 1)
        raise UsageError(f"two columns are called {twice!r}", remedy="Name one of them with AS")
    for i, column in enumerate(table.schema):
        if pa.types.is_decimal(column.type) and column.type.scale == 0:
            with suppress(pa.ArrowInvalid):  # one that is too great stays what it is
                table = table.set_column(i, column.name, table.column(i).cast(pa.int64()))
    return table


def _explained(error: Exception) -> UsageError | FileFormatError:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    what = lines[0] if lines else type(error).__name__
    if "checksum" in str(error).lower() or "IOError" in str(error) or "OSError" in str(error):
        return FileFormatError(
            f"frames cannot be read: {' '.join(lines)[:300]}",
            remedy="`foottile verify` says in which session",
        )
    return UsageError(what)
