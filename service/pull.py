"""Verified downloads of a server's sessions into folders, whole or a slice."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from http import HTTPStatus
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any
from urllib.parse import quote

import foottile
from devices.errors import DamagedFileError, UsageError
from storage.checked_json import read_checked, write_checked
from storage.checked_table import table_of
from storage.durable import (
    LOCK_NAME,
    make_folder,
    set_aside,
    storage_errors,
    sync_folder,
    temporary_of,
    write_whole,
)
from storage.file_hash import sha256_of
from storage.formats.export import ClockName
from storage.formats.options import NO_OPTIONS, FormatOptions
from storage.formats.slice import Slice
from storage.formats.written.format import Format
from storage.sessions.claims import SESSION_NAME
from storage.sessions.folder import FRAMES_NAME
from storage.verify.exported import FORMATS as PROVEN
from storage.verify.exported import verify_export

if TYPE_CHECKING:
    import httpx

_CHUNK = 1 << 20
_PARQUET = b"PAR1"
_AGAIN = "Run the same command again"


def refuse_data_folder(folder: Path) -> None:
    """Refuse to write into a data folder of a server or node.

    A folder of an earlier download is accepted; a damaged `session.json` in it is set aside.

    Args:
        folder: folder of one session; need not exist.

    Raises:
        UsageError: the folder belongs to a server or node.
        StorageError: a damaged file cannot be set aside.
    """
    remedy = "Choose a folder of your own with --out"
    for place in (folder.resolve(), *folder.resolve().parents[:4]):
        has_data = (place / "sessions").is_dir() or (place / "journal").is_dir()
        if has_data and (place / LOCK_NAME).exists():
            what = "this is a data folder, whose files are its server's or node's"
            raise UsageError(what, where=str(place), remedy=remedy)
    path = folder / SESSION_NAME
    try:
        content = json.loads(read_checked(path).text)
    except FileNotFoundError:
        return
    except ValueError:  # includes DamagedFileError
        set_aside(path)
        return
    if not isinstance(content, dict) or "complete" not in content:
        what = f"its {SESSION_NAME} is not one that `foottile pull` wrote"
        raise UsageError(what, where=str(folder), remedy=remedy)


def pull(server: foottile.Server, session_id: str, out: Path) -> dict[str, Any]:
    """Download a sealed session into the folder `out`/`session_id`.

    A partial download is resumed.

    Returns:
        The session's metadata, with `path` and `resumed_bytes`.

    Raises:
        foottile.NoAnswerError: the server does not answer, or the download was interrupted.
        foottile.UnknownError: the server does not have the session.
        foottile.ConflictError: the session is not sealed.
        foottile.DamagedError: the download differs from the server's file.
        foottile.FootTileError: another refusal by the server.
        UsageError: the id is not valid, or the folder belongs to a server or node.
        StorageError: a file cannot be written.
    """
    session = _facts(server, session_id)
    if session["sha256"] is None:
        problem = f": {session['problem']}" if session["problem"] else ""
        raise foottile.ConflictError(
            f"session {session_id} is {session['state']}{problem}; expected a sealed session. "
            "Stop it first, or wait until it is sealed"
        )
    folder = out / session_id
    refuse_data_folder(folder)
    with storage_errors(folder):
        make_folder(folder)
        sync_folder(folder)
    path = folder / FRAMES_NAME
    resumed = 0
    if not (path.is_file() and sha256_of(path) == session["sha256"]):
        resumed = _download(server, session, path)
    events = server.http.get(f"/sessions/{session_id}/events")
    ledger = server.http.get(f"/sessions/{session_id}/ledger")
    for name, content in (("session", session), ("events", events), ("ledger", ledger)):
        write_checked(folder / f"{name}.json", json.dumps(content, indent=1).encode())
    for name in ("events", "clock"):
        _pull_table(server, f"/sessions/{session_id}/{name}", folder / f"{name}.parquet")
    return {**session, "path": str(path), "resumed_bytes": resumed}


def pull_made(
    server: foottile.Server,
    session_id: str,
    out: Path,
    part: Slice,
    to: Format,
    options: FormatOptions = NO_OPTIONS,
    clock: ClockName = "node",
) -> dict[str, Any]:
    """Download a session or a slice in any format, as one file in the folder `out`.

    The server reads and sends only the slice. A slice has no hash: a Parquet file is verified by
    its pages' checksums, and its metadata state the session.

    Returns:
        The session's metadata, with `path` and `bytes`.

    Raises:
        foottile.DamagedError: the download cannot be read.
        foottile.FootTileError: the server does not answer, or refuses.
        UsageError: the id is not valid, or the folder belongs to a server or node.
        StorageError: the file cannot be written.
    """
    session = _facts(server, session_id)
    url = f"/sessions/{session_id}/data"
    path = _pull_made(server, url, session_id, out, part, to, options, clock)
    return {**session, "path": str(path), "bytes": path.stat().st_size}


def pull_take(
    server: foottile.Server,
    take_id: str,
    out: Path,
    part: Slice,
    to: Format,
    options: FormatOptions = NO_OPTIONS,
) -> dict[str, Any]:
    """Download all sessions of a take, or a slice of each, as one file in the folder `out`.

    Returns:
        The take's metadata, with `complete`, `path` and `bytes`.

    Raises:
        foottile.FootTileError: the server does not answer, or refuses.
        UsageError: the folder belongs to a server or node.
        StorageError: the file cannot be written.
    """
    url = f"/takes/{quote(take_id, safe='')}"
    take = server.http.get(url)
    complete = "lossy" if any(s["complete"] == "lossy" for s in take["sessions"]) else True
    path = _pull_made(server, f"{url}/data", f"take-{take['id']}", out, part, to, options)
    return {**take, "complete": complete, "path": str(path), "bytes": path.stat().st_size}


def _pull_made(
    server: foottile.Server,
    url: str,
    stem: str,
    out: Path,
    part: Slice,
    to: Format,
    options: FormatOptions,
    clock: ClockName | None = None,
) -> Path:
    refuse_data_folder(out)
    with storage_errors(out):
        out.mkdir(parents=True, exist_ok=True)
    end = "end" if part.end_s is None else f"{part.end_s:g}s"
    path = out / f"{stem}_{part.start_s or 0.0:g}s-{end}.{to.ending}"
    query: dict[str, object] = {"format": to.name, "start_s": part.start_s, "end_s": part.end_s}
    query["columns"], query["clock"] = ",".join(part.columns) or None, clock
    query |= options.model_dump(mode="json")
    # A temporary name until the file is verified: an interrupted download begins anew.
    partial = temporary_of(path)
    try:
        with (
            _to_do_again(_AGAIN),
            server.http.stream(url, query) as answer,
            storage_errors(partial),
            partial.open("xb") as file,
        ):
            _write(answer, file)
        # For other formats, only the connection detects truncation.
        report = verify_export(partial) if to.name in PROVEN else None
        if to.name in PROVEN and (report is None or report.problems):
            why = "it cannot be read" if report is None else report.problems[0]
            raise foottile.DamagedError(f"{server.url}: the slice is incomplete: {why}. {_AGAIN}")
        with storage_errors(path):
            partial.replace(path)
            sync_folder(path.parent)
    finally:
        partial.unlink(missing_ok=True)
    return path


def _facts(server: foottile.Server, session_id: str) -> Mapping[str, Any]:
    """Return the session's metadata; refuse an invalid id, which could name another folder."""
    if not re.fullmatch(r"[0-9A-Za-z-]{1,64}", session_id):
        raise UsageError(
            f"{session_id!r} is not a session id", remedy="List them with `foottile sessions`"
        )
    return server.session(session_id).facts


def _download(server: foottile.Server, session: Mapping[str, Any], path: Path) -> int:
    """Download the frames, resuming a partial file; return the number of resumed bytes.

    An interrupted download leaves its partial file.
    """
    partial = path.with_name(f".{path.name}.part")
    partial_bytes = partial.stat().st_size if partial.is_file() else 0
    headers = {"Accept-Encoding": "identity"}
    if partial_bytes:
        headers |= {"Range": f"bytes={partial_bytes}-", "If-Range": f'"{session["sha256"]}"'}
    resumed = partial_bytes
    try:
        with (
            _to_do_again(f"{_AGAIN}: it goes on where it stopped"),
            server.http.stream(
                f"/sessions/{session['id']}/data", {"format": "parquet"}, headers=headers
            ) as answer,
        ):
            resumed = partial_bytes if answer.status_code == HTTPStatus.PARTIAL_CONTENT else 0
            with storage_errors(partial), partial.open("ab" if resumed else "wb") as file:
                _write(answer, file)
    except foottile.FootTileError as error:
        # The partial file may be complete already, but not renamed.
        if not partial_bytes or error.status != HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE:
            raise
    if sha256_of(partial) != session["sha256"]:
        partial.unlink()
        raise foottile.DamagedError(f"{path}: the file differs from the server's hash. {_AGAIN}")
    with storage_errors(path):
        partial.replace(path)
        sync_folder(path.parent)
    return resumed


def _write(answer: httpx.Response, file: IO[bytes]) -> None:
    """Write a response to a file and sync it to disk."""
    for chunk in answer.iter_bytes(_CHUNK):
        file.write(chunk)
    file.flush()
    os.fsync(file.fileno())


@contextmanager
def _to_do_again(remedy: str) -> Iterator[None]:
    try:
        yield
    except foottile.NoAnswerError as error:
        raise foottile.NoAnswerError(f"{error} {remedy}") from error


def _pull_table(server: foottile.Server, url: str, path: Path) -> None:
    try:
        with server.http.stream(url, {"format": "parquet"}) as answer:
            content = answer.read()
    except foottile.UnknownError:
        return  # removed, or an older server without it
    if not content.startswith(_PARQUET):
        return  # an older server, which sends only JSON here
    try:
        table_of(content, where=path.name)
    except DamagedFileError as error:
        raise foottile.DamagedError(
            f"{server.url}: {error}. {_AGAIN}; if it stays so, the server's file is damaged"
        ) from error
    write_whole(path, content)
