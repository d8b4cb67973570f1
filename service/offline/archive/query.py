"""SQL queries over many sealed sessions, run by DuckDB on Arrow tables that this module makes.

DuckDB itself opens no file and no connection: it receives tables and frames through Arrow, and all
other access is disabled before the query is parsed.

A session is accepted if the checksum of its `session.json` is right and its frames file has the
length stated there.

Frames are verified as they are read. Sessions are not changed, except that missing stances of an
older session are computed and stored beside its frames if its folder is writable.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow as pa
import pyarrow.dataset as ds
import pyarrow.fs as fs

from devices.errors import FileFormatError, FootTileError, UnknownError, UsageError, require_extra
from service.offline.archive.local_copies import map_in_threads
from service.offline.archive.locations import (
    SessionLocation,
    check_utf8,
    find_session_locations,
    is_remote,
    list_file_sizes,
    open_filesystem,
    open_for_reading,
    read_bytes,
)
from service.sessions.stances import load_stances
from storage.durable_files import write_atomically
from storage.sessions.folder import FRAMES_NAME
from storage.sessions.footer import SealedFileFooter
from storage.sessions.metadata import (
    LEDGER_NAME,
    MARKERS_NAME,
    PULLED_MARKERS_NAME,
    SESSION_NAME,
    StoredMetadata,
    parse_session_metadata,
    read_bytes_or_none,
    read_existing_markers,
)
from storage.sessions.stances import STANCE_SCHEMA, STANCES_NAME

if TYPE_CHECKING:
    import duckdb


_ID: pa.Field[Any] = pa.field("session_id", pa.string(), nullable=False)
_SESSION_COLUMNS: list[tuple[str, pa.DataType]] = [
    ("name", pa.string()),
    ("node", pa.string()),
    ("scene", pa.string()),
    ("subject", pa.string()),
    ("notes", pa.string()),
    ("tags", pa.list_(pa.string())),
    ("started_t_ns", pa.int64()),
    ("stopped_t_ns", pa.int64()),
    ("duration_s", pa.float64()),
    ("frames", pa.int64()),
    ("lossy", pa.bool_()),
    ("not_sampled_frames", pa.int64()),
    ("not_sampled_share", pa.float64()),
    ("bytes", pa.int64()),
    ("calibration_id", pa.string()),
    ("absolute_scale", pa.string()),
    ("problem", pa.string()),
    ("folder", pa.string()),
]
SESSIONS_SCHEMA = pa.schema([_ID, *(pa.field(name, type_) for name, type_ in _SESSION_COLUMNS)])
MARKERS_SCHEMA = pa.schema(
    [_ID, pa.field("id", pa.string()), pa.field("label", pa.string()), pa.field("t_ns", pa.int64())]
)
STANCES_SCHEMA = pa.schema([_ID, *(STANCE_SCHEMA.field(name) for name in STANCE_SCHEMA.names)])


@dataclass(frozen=True)
class SealedSession:
    """Sealed session of an archive.

    Attributes:
        location: its location.
        folder: local folder of the session, or of the files copied from a store.
        metadata: content of its `session.json`.
    """

    location: SessionLocation
    folder: Path
    metadata: StoredMetadata

    @property
    def session_id(self) -> str:
        """Session id, which is also the folder's name."""
        return self.location.session_id

    @property
    def has_frames(self) -> bool:
        """True if a frame was recorded."""
        return self.metadata.content.get("sha256") is not None

    @property
    def is_remote(self) -> bool:
        """True if the session is in an object store."""
        return is_remote(self.location.uri)

    def load_stances(self) -> pa.Table:
        """Return the stances, as of `service.sessions.stances`; download the frames if needed."""
        sha256 = str(self.metadata.content["sha256"])
        if self.is_remote:
            with suppress(FileFormatError):
                return load_stances(self.folder, frames_sha256=sha256)
            self.download_file(FRAMES_NAME)
        return load_stances(self.folder, frames_sha256=sha256, store=True)

    def download_file(self, name: str) -> None:
        """Download a file of a remote session, if it exists and was not downloaded before."""
        if self.is_remote and not (self.folder / name).exists():
            with suppress(FileFormatError):
                write_atomically(self.folder / name, read_bytes(f"{self.location.uri}/{name}"))


@dataclass
class SessionArchive:
    """Sealed sessions for queries, and the ones left out.

    Attributes:
        sessions: sealed sessions without known damage.
        left_out_reasons: reasons for missing sessions, by location.
    """

    sessions: list[SealedSession] = field(default_factory=list)
    left_out_reasons: dict[str, str] = field(default_factory=dict)

    def build_sessions_table(self) -> pa.Table:
        """Build the table of sessions, one row each."""
        rows = []
        for each in self.sessions:
            ledger = each.metadata.ledger
            about: dict[str, Any] = {
                "session_id": each.session_id,
                "lossy": None if ledger is None else ledger.lossy,
                "not_sampled_frames": None if ledger is None else ledger.missed_slots,
                "not_sampled_share": None if ledger is None else ledger.not_sampled_share,
                "folder": each.location.uri,
            }
            rows.append({**each.metadata.content, **about})
        return pa.Table.from_pylist(rows, schema=SESSIONS_SCHEMA)

    def build_markers_table(self) -> pa.Table:
        """Build the table of markers, one row each."""
        rows: list[dict[str, Any]] = []
        self._download_files(MARKERS_NAME)
        for each in list(self.sessions):
            try:
                events = _read_markers(each)
            except FootTileError as error:
                self._leave_out(each, error)
                continue
            rows += [{"session_id": each.session_id, **event} for event in events]
        return pa.Table.from_pylist(rows, schema=MARKERS_SCHEMA)

    def build_stances_table(self) -> pa.Table:
        """Build the table of stances, one row each; sessions without estimates have none."""
        tables, ids = [STANCE_SCHEMA.empty_table()], [pa.array([], pa.string())]
        self._download_files(STANCES_NAME)
        for each in list(self.sessions):
            if not each.has_frames:
                continue
            try:
                table = each.load_stances()
            except UnknownError:
                continue
            except FootTileError as error:
                self._leave_out(each, error)
                continue
            tables.append(table)
            ids.append(pa.repeat(each.session_id, len(table)))
        columns = pa.concat_tables(tables).columns
        return pa.Table.from_arrays([pa.chunked_array(ids), *columns], schema=STANCES_SCHEMA)

    def open_frames_dataset(self) -> ds.Dataset:
        """Return the frames of all sessions as a lazy dataset; each page is verified when read."""
        schema = pa.schema([_ID])
        by_filesystem: list[tuple[fs.FileSystem, list[str], list[str]]] = []
        for each, own in list(self._read_schemas()):
            if isinstance(own, Exception):
                self._leave_out(each, own)
                continue
            schema = pa.unify_schemas([schema, pa.schema([(f.name, f.type) for f in own])])
            filesystem, path = open_filesystem(each.location.frames_uri)
            known = next((k for k in by_filesystem if k[0].equals(filesystem)), None)
            if known is None:
                by_filesystem.append(known := (filesystem, [], []))
            known[1].append(path)
            known[2].append(each.session_id)
        options = ds.ParquetFragmentScanOptions(page_checksum_verification=True)
        parts: list[ds.Dataset] = [
            ds.FileSystemDataset.from_paths(
                paths,
                schema=schema,
                format=ds.ParquetFileFormat(default_fragment_scan_options=options),
                filesystem=filesystem,
                partitions=[ds.field("session_id") == session_id for session_id in ids],
            )
            for filesystem, paths, ids in by_filesystem or [(fs.LocalFileSystem(), [], [])]
        ]
        return parts[0] if len(parts) == 1 else ds.dataset(parts, schema=schema)

    def _read_schemas(self) -> Iterator[tuple[SealedSession, pa.Schema | Exception]]:
        """Yield the verified frames schema of every session with frames, or the error."""
        having = [each for each in self.sessions if each.has_frames]
        waits = any(each.is_remote for each in having)
        yield from zip(
            having, map_in_threads(_read_verified_schema, having, is_remote=waits), strict=True
        )

    def _download_files(self, name: str) -> None:
        """Download a file of every remote session; leave out sessions that cannot be read."""

        def fetch(session: SealedSession) -> Exception | None:
            try:
                session.download_file(name)
            except FootTileError as error:
                return error
            return None

        remote = [each for each in self.sessions if each.is_remote]
        for each, error in zip(remote, map_in_threads(fetch, remote, is_remote=True), strict=True):
            if error is not None:
                self._leave_out(each, error)

    def _leave_out(self, session: SealedSession, reason: Exception) -> None:
        """Leave a session found damaged while reading out of all tables made from now on."""
        self.sessions.remove(session)
        what = reason.what if isinstance(reason, FootTileError) else str(reason)
        self.left_out_reasons[session.location.uri] = f"damaged: {what}"


def _read_verified_schema(session: SealedSession) -> pa.Schema | Exception:
    try:
        with open_for_reading(session.location.frames_uri) as file:
            return SealedFileFooter(
                Path(session.location.frames_uri), only_slices=True, file=file
            ).schema
    except (FootTileError, pa.ArrowException) as error:
        return error


def _read_markers(session: SealedSession) -> list[dict[str, Any]]:
    whole = session.metadata.session
    if whole is not None:
        return [event.model_dump() for event in whole.markers]
    try:  # one that was pulled
        stored = read_existing_markers(session.folder / MARKERS_NAME)
    except FileNotFoundError:
        return []
    return [event.model_dump() for event in stored]


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
