"""SQL queries over many sessions, run by DuckDB on Arrow tables, and the search for sessions.

DuckDB itself opens no file and no connection: it receives tables and frames through Arrow, and all
other access is disabled before the query is parsed.

A session is accepted if the checksum of its `session.json` is right and its frames file has the
length stated there.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow as pa

from devices.errors import FileFormatError, FootTileError, UsageError, require_extra
from service.offline.archive.local_copies import map_in_threads
from service.offline.archive.locations import (
    SessionLocation,
    check_utf8,
    find_session_locations,
    is_remote,
    list_file_sizes,
    read_bytes,
)
from service.offline.archive.session_tables import SealedSession, SessionArchive
from storage.durable_files import write_atomically
from storage.sessions.folder import FRAMES_NAME
from storage.sessions.metadata import (
    LEDGER_NAME,
    PULLED_MARKERS_NAME,
    SESSION_NAME,
    parse_session_metadata,
    read_bytes_or_none,
)

if TYPE_CHECKING:
    import duckdb

    from service.offline.archive.session_tables import SessionArchive

VIEWS = ("sessions", "stances", "markers", "frames")
LOCKED_SETTINGS: dict[str, Any] = {
    "enable_external_access": False,  # no file is read or written, nothing attached or loaded
    "autoinstall_known_extensions": False,
    "autoload_known_extensions": False,
    "allow_community_extensions": False,
    "python_enable_replacements": False,  # no access to Python variables by name
    "temp_directory": "",
    # Half of the machine's memory. DuckDB up to 1.5 does not accept "50%".
    "memory_limit": f"{os.sysconf('SC_PAGE_SIZE') * os.sysconf('SC_PHYS_PAGES') // 2}B",
    "lock_configuration": True,
}


def run_query(archive: SessionArchive, sql: str) -> pa.Table:
    """Run one SELECT statement.

    Args:
        archive: the sessions; damaged ones are left out and added to `archive.left_out`.
        sql: statement over the views `VIEWS`; only views that it names are created.

    Raises:
        MissingExtraError: DuckDB is not installed.
        UsageError: it is not one SELECT, names an unknown object, or needs disabled access.
        FileFormatError: frames that it reads are damaged.
    """
    with require_extra("archive", "`foottile query`"):
        import duckdb
    with duckdb.connect(":memory:", config=LOCKED_SETTINGS) as connection:
        try:
            _check_is_select(connection, sql)
            makers: dict[str, Callable[[], Any]] = {
                "frames": archive.open_frames_dataset,
                "stances": archive.build_stances_table,
                "markers": archive.build_markers_table,
                "sessions": archive.build_sessions_table,  # last: without those found damaged
            }
            requested = _find_named_views(connection, sql)
            for name, make in makers.items():
                if name in requested:
                    connection.register(name, make())
            return _cast_sums_to_int64(
                _cast_intervals_to_text(connection.sql(sql)).to_arrow_table()
            )
        except (duckdb.Error, pa.ArrowException) as error:
            raise _convert_duckdb_error(error) from error


def _check_is_select(connection: duckdb.DuckDBPyConnection, sql: str) -> None:
    kinds = [statement.type.name for statement in connection.extract_statements(sql)]
    if kinds not in (["SELECT"], ["EXPLAIN"]):
        raise UsageError(
            f"the question is {' and '.join(kinds) or 'empty'}",
            expected="one SELECT over " + ", ".join(VIEWS),
        )


def _find_named_views(connection: duckdb.DuckDBPyConnection, sql: str) -> set[str]:
    """Return the views that a statement names; data of other views is not read."""
    mentioned = {name for name in VIEWS if re.search(rf"\b{name}\b", sql, re.IGNORECASE)}
    found = connection.execute("SELECT json_serialize_sql(?::VARCHAR)", [sql]).fetchall()
    tree = json.loads(found[0][0])
    if tree["error"]:  # not given for some statements, such as EXPLAIN
        return mentioned
    return {name for name in _iterate_table_names(tree) if name in mentioned}


def _iterate_table_names(node: Any) -> Iterator[str]:
    if isinstance(node, dict):
        if isinstance(name := node.get("table_name"), str):
            yield name.lower()
        node = list(node.values())
    if isinstance(node, list):
        for each in node:
            yield from _iterate_table_names(each)


def _cast_intervals_to_text(answer: duckdb.DuckDBPyRelation) -> duckdb.DuckDBPyRelation:
    """Cast intervals to text: CSV, Parquet and JSON have no type for months."""
    if not any("INTERVAL" in str(kind) for kind in answer.types):
        return answer
    names = [f'"{name.replace(chr(34), chr(34) * 2)}"' for name in answer.columns]
    return answer.project(
        ", ".join(
            f"CAST({name} AS VARCHAR) AS {name}" if "INTERVAL" in str(kind) else name
            for name, kind in zip(names, answer.types, strict=True)
        )
    )


def _cast_sums_to_int64(table: pa.Table) -> pa.Table:
    """Cast integer sums to int64: DuckDB returns decimals of 38 digits."""
    if len(set(table.column_names)) < len(table.column_names):
        twice = next(n for n in table.column_names if table.column_names.count(n) > 1)
        raise UsageError(f"two columns are called {twice!r}", remedy="Name one of them with AS")
    for i, column in enumerate(table.schema):
        if pa.types.is_decimal(column.type) and column.type.scale == 0:
            with suppress(pa.ArrowInvalid):  # a sum beyond int64 stays a decimal
                table = table.set_column(i, column.name, table.column(i).cast(pa.int64()))
    return table


def _convert_duckdb_error(error: Exception) -> UsageError | FileFormatError:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    what = lines[0] if lines else type(error).__name__
    if "checksum" in str(error).lower() or "IOError" in str(error) or "OSError" in str(error):
        return FileFormatError(
            f"frames cannot be read: {' '.join(lines)[:300]}",
            remedy="`foottile verify` says in which session",
        )
    return UsageError(what)


def find_sessions(locations: Sequence[str], download_folder: Path | None = None) -> SessionArchive:
    """Find all sealed sessions at some locations.

    Args:
        locations: paths, globs or URIs; see `service.offline.archive.locations`.
        download_folder: empty folder for metadata copied from object stores; required for
            remote sessions.

    Raises:
        UsageError: a location does not exist.
        StorageError: a store does not answer.
    """
    found = SessionArchive()
    seen: dict[str, SessionLocation] = {}
    every = sorted(find_session_locations(locations), key=lambda place: place.session_id)
    waits = any(is_remote(place.uri) for place in every)
    looked = map_in_threads(
        partial(_load_sealed_session, download_folder=download_folder), every, is_remote=waits
    )
    for place, (reason, session) in zip(every, looked, strict=True):
        other = seen.get(place.session_id)
        if session is None:
            found.left_out_reasons[place.uri] = reason
        elif other is not None:
            if not _is_same_location(place.uri, other.uri):
                found.left_out_reasons[place.uri] = f"it is also in {other.uri}"
        else:
            seen[place.session_id] = place
            found.sessions.append(session)
    return found


def _is_same_location(one: str, other: str) -> bool:
    if is_remote(one) or is_remote(other):
        return one == other
    return os.path.samefile(one, other)


def _load_sealed_session(
    place: SessionLocation, download_folder: Path | None
) -> tuple[str, SealedSession | None]:
    """Return the session; or, with None, the reason to leave it out."""
    if place.is_single_file:
        return "it is a single file, not a session's folder", None
    try:
        check_utf8(place)
    except FootTileError as error:
        return error.what, None
    folder, sizes = Path(place.uri), None
    if is_remote(place.uri):
        if download_folder is None:
            raise ValueError("remote sessions need a folder for downloads")
        folder = (
            download_folder / hashlib.sha256(place.uri.encode()).hexdigest()[:16] / place.session_id
        )
        try:
            sizes = list_file_sizes(place.uri)
            folder.mkdir(parents=True, exist_ok=True)
            for name in (SESSION_NAME, LEDGER_NAME, PULLED_MARKERS_NAME):
                if name in sizes:
                    write_atomically(folder / name, read_bytes(f"{place.uri}/{name}"))
        except FootTileError as error:
            return str(error), None
    problems: list[str] = []
    metadata = parse_session_metadata(folder, read_bytes_or_none(folder / SESSION_NAME), problems)
    if problems or metadata is None:
        return f"damaged: {'; '.join(problems)}", None
    content = metadata.content
    if content["id"] != place.session_id:
        return f"it is session {content['id']} in another session's folder", None
    if content["state"] != "sealed":
        return f"it is {content['state']}, and not sealed yet", None
    if content.get("sha256") is not None:
        path = folder / FRAMES_NAME
        if sizes is None:
            sizes = {FRAMES_NAME: path.stat().st_size} if path.is_file() else {}
        if FRAMES_NAME not in sizes:
            return f"damaged: {FRAMES_NAME} is missing", None
        if sizes[FRAMES_NAME] != content["bytes"]:
            return f"damaged: {FRAMES_NAME} is not as long as {SESSION_NAME} says", None
    return "", SealedSession(place, folder, metadata)
