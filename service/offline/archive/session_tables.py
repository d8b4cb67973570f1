"""Tables over sealed sessions, for queries, with the reason for each session left out.

Frames are verified as they are read. Sessions are not changed, except that missing stances of an
older session are computed and stored beside its frames if its folder is writable.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.dataset as ds
import pyarrow.fs as fs

from devices.errors import FileFormatError, FootTileError, UnknownError
from service.offline.archive.local_copies import map_in_threads
from service.offline.archive.locations import (
    SessionLocation,
    is_remote,
    open_filesystem,
    open_for_reading,
    read_bytes,
)
from service.sessions.stances import load_stances
from storage.durable_files import write_atomically
from storage.sessions.folder import FRAMES_NAME
from storage.sessions.footer import SealedFileFooter
from storage.sessions.metadata import MARKERS_NAME, StoredMetadata, read_markers
from storage.sessions.stances import STANCE_SCHEMA, STANCES_NAME

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
            lossy = ledger.lossy if ledger is not None else None
            about = {"session_id": each.session_id, "lossy": lossy, "folder": each.location.uri}
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
        stored = read_markers(session.folder / MARKERS_NAME)
    except FileNotFoundError:
        return []
    return [event.model_dump() for event in stored]
