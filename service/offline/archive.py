"""Sealed sessions in folders, found for questions about many of them, and what is left out.

Each is taken by its `session.json`, held against its hash; its frames have the length that it says
there, and are proven when they are read. No session is changed: stances that an older one lacks are
made beside its frames, where its folder may be written to.
"""

from __future__ import annotations

import glob
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.dataset as ds
import pyarrow.fs as fs

from devices.errors import FootTileError, UnknownError, UsageError
from service.sessions.stances import stances_of_session
from storage.sessions.beside import EVENTS_NAME, read_events
from storage.sessions.claims import SESSION_NAME, Claims, bytes_of, claims_in
from storage.sessions.folder import FRAMES_NAME, SESSION_ID
from storage.sessions.footer import Footer
from storage.sessions.stances import SCHEMA

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
SESSIONS = pa.schema([_ID, *(pa.field(name, type_) for name, type_ in _SESSION_COLUMNS)])
EVENTS = pa.schema(
    [_ID, pa.field("id", pa.string()), pa.field("label", pa.string()), pa.field("t_ns", pa.int64())]
)
STANCES = pa.schema([_ID, *(SCHEMA.field(name) for name in SCHEMA.names)])


@dataclass(frozen=True)
class Archived:
    """One sealed session."""

    folder: Path
    said: Claims

    @property
    def id(self) -> str:
        """Of the session, and its folder's name."""
        return self.folder.name

    @property
    def has_frames(self) -> bool:
        """Was a frame recorded?"""
        return self.said.content.get("sha256") is not None


@dataclass
class Archive:
    """Sessions, and what was left out of them.

    Attributes:
        sessions: sealed and whole as far as was looked.
        left_out: why something is not in the answers, by its path.
    """

    sessions: list[Archived] = field(default_factory=list)
    left_out: dict[str, str] = field(default_factory=dict)

    def sessions_table(self) -> pa.Table:
        """A row for each session."""
        rows = []
        for each in self.sessions:
            ledger = each.said.ledger
            lossy = ledger.lossy if ledger is not None else None
            about = {"session_id": each.id, "lossy": lossy, "folder": str(each.folder)}
            rows.append({**each.said.content, **about})
        return pa.Table.from_pylist(rows, schema=SESSIONS)

    def events_table(self) -> pa.Table:
        """A row for each mark."""
        rows: list[dict[str, Any]] = []
        for each in list(self.sessions):
            try:
                events = _events(each)
            except FootTileError as error:
                self._leave_out(each, error)
                continue
            rows += [{"session_id": each.id, **event} for event in events]
        return pa.Table.from_pylist(rows, schema=EVENTS)

    def stances_table(self) -> pa.Table:
        """A row for each stance; sessions without estimates have none."""
        tables, ids = [SCHEMA.empty_table()], [pa.array([], pa.string())]
        for each in list(self.sessions):
            if not each.has_frames:
                continue
            sha256 = str(each.said.content["sha256"])
            try:
                table = stances_of_session(each.folder, frames_sha256=sha256, keep=True)
            except UnknownError:
                continue
            except FootTileError as error:
                self._leave_out(each, error)
                continue
            tables.append(table)
            ids.append(pa.repeat(each.id, len(table)))
        columns = pa.concat_tables(tables).columns
        return pa.Table.from_arrays([pa.chunked_array(ids), *columns], schema=STANCES)

    def frames(self) -> ds.Dataset:
        """All frames, of which no more is read than a question needs; each page is proven."""
        paths, parts = [], []
        schema = pa.schema([_ID])
        for each in list(self.sessions):
            path = each.folder / FRAMES_NAME
            if not each.has_frames:
                continue
            try:
                own = Footer(path, only_slices=True).schema
                schema = pa.unify_schemas([schema, pa.schema([(f.name, f.type) for f in own])])
            except (FootTileError, pa.ArrowException) as error:
                self._leave_out(each, error)
                continue
            paths.append(str(path))
            parts.append(ds.field("session_id") == each.id)
        options = ds.ParquetFragmentScanOptions(page_checksum_verification=True)
        return ds.FileSystemDataset.from_paths(
            paths,
            schema=schema,
            format=ds.ParquetFileFormat(default_fragment_scan_options=options),
            filesystem=fs.LocalFileSystem(),
            partitions=parts,
        )

    def _leave_out(self, session: Archived, reason: Exception) -> None:
        """Found damaged only when it is read: it is in no table then that is made from now on."""
        self.sessions.remove(session)
        what = reason.what if isinstance(reason, FootTileError) else str(reason)
        self.left_out[str(session.folder)] = f"damaged: {what}"


def find_sessions(places: Sequence[str]) -> Archive:
    """All sealed sessions in some places.

    Args:
        places: data folders, folders of sessions, folders of one session, or globs of these.

    Raises:
        UsageError: one of them is not there.
    """
    found = Archive()
    seen: dict[str, Path] = {}
    for folder in _folders(places):
        reason, session = _looked_at(folder)
        if session is not None and folder.name in seen:
            if folder.samefile(seen[folder.name]):
                continue
            reason, session = f"it is also in {seen[folder.name]}", None
        if session is None:
            found.left_out[str(folder)] = reason
        else:
            seen[folder.name] = folder
            found.sessions.append(session)
    return found


def _folders(places: Sequence[str]) -> Iterator[Path]:
    for place in places:
        paths = [Path(place)] if Path(place).exists() else map(Path, sorted(glob.glob(place)))
        folders = [path for path in paths if path.is_dir()]
        if not folders:
            raise UsageError(
                f"no folder {place!r}",
                expected="a data folder, a folder of sessions, one of them, or a glob of these",
            )
        for folder in folders:
            inside = folder / "sessions" if (folder / "sessions").is_dir() else folder
            if (folder / SESSION_NAME).is_file() or SESSION_ID.fullmatch(folder.name):
                yield folder
            else:
                yield from sorted(p for p in inside.iterdir() if SESSION_ID.fullmatch(p.name))


def _looked_at(folder: Path) -> tuple[str, Archived | None]:
    """The session, or why it is left out."""
    problems: list[str] = []
    said = claims_in(folder, bytes_of(folder / SESSION_NAME), problems, [])
    if problems or said is None:
        return f"damaged: {'; '.join(problems)}", None
    content = said.content
    if content["id"] != folder.name:
        return f"it is session {content['id']}, in the folder of another", None
    if content["state"] != "sealed":
        return f"it is {content['state']}, and not sealed yet", None
    if content.get("sha256") is not None:
        path = folder / FRAMES_NAME
        if not path.is_file():
            return f"damaged: {FRAMES_NAME} is missing", None
        if path.stat().st_size != content["bytes"]:
            return f"damaged: {FRAMES_NAME} is not as long as {SESSION_NAME} says", None
    return "", Archived(folder, said)


def _events(session: Archived) -> list[dict[str, Any]]:
    whole = session.said.whole
    if whole is not None:
        return [event.model_dump() for event in whole.events]
    try:  # one that was pulled
        stored = read_events(session.folder / EVENTS_NAME)
    except FileNotFoundError:
        return []
    return [event.model_dump() for event in stored.events]
