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
from storage.documents import read_checksummed_json, write_checksummed_json
from storage.durable_files import (
    LOCK_NAME,
    make_synced_folder,
    make_temporary_path,
    set_aside_damaged,
    sync_folder,
    translate_storage_errors,
    write_atomically,
)
from storage.formats.export import ClockName
from storage.formats.slice import NO_OPTIONS, FormatOptions, Slice
from storage.formats.writers.format import ExportFormat
from storage.parquet_hash import compute_sha256, parse_hashed_table
from storage.sessions.folder import FRAMES_NAME
from storage.sessions.metadata import SESSION_NAME, write_sha256_sums
from storage.verify.sealed_file import RECOGNISED_FORMATS as PROVEN
from storage.verify.sealed_file import recognise_export_and_check_not_cut_off

if TYPE_CHECKING:
    import httpx

_CHUNK_BYTES = 1 << 20
_RETRY_REMEDY = "Run the same command again"


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
        content = json.loads(read_checksummed_json(path))
    except FileNotFoundError:
        return
    except ValueError:  # includes DamagedFileError
        set_aside_damaged(path)
        return
    if not isinstance(content, dict) or "complete" not in content:
        what = f"its {SESSION_NAME} is not one that `foottile pull` wrote"
        raise UsageError(what, where=str(folder), remedy=remedy)


def pull_session(server: foottile.Client, session_id: str, out_folder: Path) -> dict[str, Any]:
    """Download a sealed session into the folder `out`/`session_id`.

    A partial download is resumed.

    Returns:
        The session's metadata, with `path` and `resumed_bytes`.

    Raises:
        foottile.NoAnswerError: the server does not answer, or the download was interrupted.
        foottile.UnknownError: the server does not have the session.
        foottile.ConflictError: the session is not sealed.
        foottile.DamagedError: the download differs from the server's file.
        foottile.ClientError: another refusal by the server.
        UsageError: the id is not valid, or the folder belongs to a server or node.
        StorageError: a file cannot be written.
    """
    session = _get_session_metadata(server, session_id)
    if session["sha256"] is None:
        problem = f": {session['problem']}" if session["problem"] else ""
        raise foottile.ConflictError(
            f"session {session_id} is {session['state']}{problem}; expected a sealed session. "
            "Stop it first, or wait until it is sealed"
        )
    folder = out_folder / session_id
    refuse_data_folder(folder)
    with translate_storage_errors(folder):
        make_synced_folder(folder)
        sync_folder(folder)
    path = folder / FRAMES_NAME
    resumed = 0
    if not (path.is_file() and compute_sha256(path) == session["sha256"]):
        resumed = _download_frames(server, session, path)
    markers = server.http.get(f"/sessions/{session_id}/markers")
    ledger = server.http.get(f"/sessions/{session_id}/ledger")
    for name, content in (("session", session), ("markers", markers), ("ledger", ledger)):
        write_checksummed_json(folder / f"{name}.json", json.dumps(content, indent=1).encode())
    for name in ("markers", "clock", "warm-up"):
        table = f"{name.replace('-', '_')}.parquet"
        _pull_table(server, f"/sessions/{session_id}/{name}", folder / table)
    write_sha256_sums(folder, session["sha256"])
    return {**session, "path": str(path), "resumed_bytes": resumed}


def pull_export(
    server: foottile.Client,
    session_id: str,
    out_folder: Path,
    selection: Slice,
    export_format: ExportFormat,
    options: FormatOptions = NO_OPTIONS,
    clock: ClockName = "node",
) -> dict[str, Any]:
    """Download a session or a slice in any format, as one file in the folder `out`.

    The server reads and sends only the slice. A slice has no hash: a Parquet file is verified by
    its pages' checksums, and its metadata state the session.

    Returns:
        The session's metadata, with `path`, `bytes` and `remarks` of the format: filled gaps and
        rows left out; empty: none.

    Raises:
        foottile.DamagedError: the download cannot be read.
        foottile.ClientError: the server does not answer, or refuses.
        UsageError: the id is not valid, or the folder belongs to a server or node.
        StorageError: the file cannot be written.
    """
    session = _get_session_metadata(server, session_id)
    url = f"/sessions/{session_id}/data"
    downloaded = _download_export(
        server, url, session_id, out_folder, selection, export_format, options, clock
    )
    return {**session, **downloaded}


def pull_take_export(
    server: foottile.Client,
    take_id: str,
    out_folder: Path,
    selection: Slice,
    export_format: ExportFormat,
    options: FormatOptions = NO_OPTIONS,
) -> dict[str, Any]:
    """Download all sessions of a take, or a slice of each, as one file in the folder `out`.

    Returns:
        The take's metadata, with `complete`, and `path`, `bytes` and `remarks` as for a session.

    Raises:
        foottile.ClientError: the server does not answer, or refuses.
        UsageError: the folder belongs to a server or node.
        StorageError: the file cannot be written.
    """
    url = f"/takes/{quote(take_id, safe='')}"
    take = server.http.get(url)
    complete = "lossy" if any(s["complete"] == "lossy" for s in take["sessions"]) else True
    downloaded = _download_export(
        server, f"{url}/data", f"take-{take['id']}", out_folder, selection, export_format, options
    )
    return {**take, "complete": complete, **downloaded}


def _download_export(
    server: foottile.Client,
    url: str,
    stem: str,
    out_folder: Path,
    selection: Slice,
    export_format: ExportFormat,
    options: FormatOptions,
    clock: ClockName | None = None,
) -> dict[str, Any]:
    """Download an export; return its `path`, `bytes` and `remarks`."""
    refuse_data_folder(out_folder)
    with translate_storage_errors(out_folder):
        out_folder.mkdir(parents=True, exist_ok=True)
    end = "end" if selection.end_s is None else f"{selection.end_s:g}s"
    path = out_folder / f"{stem}_{selection.start_s or 0.0:g}s-{end}{export_format.ending}"
    query: dict[str, object] = {
        "format": export_format.name,
        "start_s": selection.start_s,
        "end_s": selection.end_s,
    }
    query["columns"], query["clock"] = ",".join(selection.columns) or None, clock
    query |= options.model_dump(mode="json")
    # A temporary name until the file is verified: an interrupted download begins anew.
    partial = make_temporary_path(path)
    try:
        with (
            _append_retry_remedy(_RETRY_REMEDY),
            server.http.stream(url, query) as answer,
            translate_storage_errors(partial),
            partial.open("xb") as file,
        ):
            remarks = answer.headers.get("Foottile-Remarks", "")
            _write_response(answer, file)
        # For other formats, only the connection detects truncation.
        report = (
            recognise_export_and_check_not_cut_off(partial)
            if export_format.name in PROVEN
            else None
        )
        if export_format.name in PROVEN and (report is None or report.problems):
            why = "it cannot be read" if report is None else report.problems[0]
            raise foottile.DamagedError(
                f"{server.url}: the slice is incomplete: {why}. {_RETRY_REMEDY}"
            )
        with translate_storage_errors(path):
            partial.replace(path)
            sync_folder(path.parent)
    finally:
        partial.unlink(missing_ok=True)
    return {"path": str(path), "bytes": path.stat().st_size, "remarks": remarks}


def _get_session_metadata(server: foottile.Client, session_id: str) -> Mapping[str, Any]:
    """Return the session's metadata; refuse an invalid id, which could name another folder."""
    if not re.fullmatch(r"[0-9A-Za-z-]{1,64}", session_id):
        raise UsageError(
            f"{session_id!r} is not a session id", remedy="List them with `foottile sessions`"
        )
    return server.session(session_id).metadata


def _download_frames(server: foottile.Client, session: Mapping[str, Any], path: Path) -> int:
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
            _append_retry_remedy(f"{_RETRY_REMEDY}: it goes on where it stopped"),
            server.http.stream(
                f"/sessions/{session['id']}/data", {"format": "parquet"}, headers=headers
            ) as answer,
        ):
            resumed = partial_bytes if answer.status_code == HTTPStatus.PARTIAL_CONTENT else 0
            with translate_storage_errors(partial), partial.open("ab" if resumed else "wb") as file:
                _write_response(answer, file)
    except foottile.ClientError as error:
        # The partial file may be complete already, but not renamed.
        if not partial_bytes or error.status != HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE:
            raise
    if compute_sha256(partial) != session["sha256"]:
        partial.unlink()
        raise foottile.DamagedError(
            f"{path}: the file differs from the server's hash. {_RETRY_REMEDY}"
        )
    with translate_storage_errors(path):
        partial.replace(path)
        sync_folder(path.parent)
    return resumed


def _write_response(response: httpx.Response, file: IO[bytes]) -> None:
    """Write a response to a file and sync it to disk."""
    for chunk in response.iter_bytes(_CHUNK_BYTES):
        file.write(chunk)
    file.flush()
    os.fsync(file.fileno())


@contextmanager
def _append_retry_remedy(remedy: str) -> Iterator[None]:
    try:
        yield
    except foottile.ServerUnavailableError as error:
        raise foottile.ServerUnavailableError(f"{error} {remedy}") from error


def _pull_table(server: foottile.Client, url: str, path: Path) -> None:
    try:
        with server.http.stream(url, {"format": "parquet"}) as answer:
            content = answer.read()
    except foottile.NotFoundError:
        return  # a rebuilt session may lack its clock, and many have no warm-up
    try:
        parse_hashed_table(content, where=path.name)
    except DamagedFileError as error:
        raise foottile.DamagedError(
            f"{server.url}: {error}. {_RETRY_REMEDY}; if it stays so, the server's file is damaged"
        ) from error
    write_atomically(path, content)
