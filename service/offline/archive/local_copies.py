"""Local copies of sessions and files in object stores, and temporary folders of workers.

Temporary folders are named by machine and process, because several machines may share the parent
folder.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import socket
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from devices.errors import DamagedFileError, FileFormatError, StateError
from service.offline.archive.locations import (
    SessionLocation,
    is_remote,
    list_file_sizes,
    open_for_reading,
    parse_session_location,
    read_bytes,
)
from storage.durable_files import (
    is_dead_process_temporary,
    make_temporary_path,
    translate_storage_errors,
)
from storage.parquet_hash import read_footer_or_empty_from
from storage.sessions.folder import FRAMES_NAME
from storage.sessions.metadata import (
    SESSION_NAME,
    StoredMetadata,
    parse_session_metadata,
    read_bytes_or_none,
)

_MACHINE = re.sub(r"[^\w-]", "-", socket.gethostname())
SYSTEM_TEMP_FOLDER = Path(tempfile.gettempdir()) / f"foottile-{os.getuid()}"
"""Parent of the temporary folders for downloads and uploads."""


@contextmanager
def create_workspace(parent: Path) -> Iterator[Path]:
    """Provide an empty folder in `parent`, created if missing; delete it when the block ends.

    Raises:
        StorageError: it cannot be created.
    """
    with translate_storage_errors(parent, "Name a folder that can be written to"):
        parent.mkdir(0o700, parents=True, exist_ok=True)
        folder = make_temporary_path(parent / _MACHINE)
        folder.mkdir()
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def remove_stale_workspaces(parent: Path) -> None:
    """Delete folders left by killed processes of this machine."""
    for folder in parent.glob(f".{_MACHINE}.*.tmp"):
        if is_dead_process_temporary(folder.name):
            shutil.rmtree(folder, ignore_errors=True)


_BLOCK = 1 << 20
_MAX_REQUESTS = 16
"""Concurrent requests to a store."""
_In = TypeVar("_In")
_Out = TypeVar("_Out")


def hash_session(location: SessionLocation) -> str:
    """Hash a session's `session.json`, which contains the hash of its frames.

    Raises:
        FileFormatError: it is not there.
        StorageError: it cannot be read now.
    """
    if location.is_single_file:
        with open_for_reading(location.uri) as file:
            metadata = read_footer_or_empty_from(file)
    else:
        metadata = read_bytes(f"{location.uri}/{SESSION_NAME}")
    return hashlib.sha256(metadata).hexdigest()


def hash_file_or_session(uri: str) -> str:
    """Hash any file; for a session's frames, return `hash_session` of the session.

    Raises:
        FileFormatError: it is not there.
        StorageError: it cannot be read now.
    """
    place = parse_session_location(uri)
    if place.uri != uri:
        return hash_session(place)
    digest = hashlib.sha256()
    with open_for_reading(uri) as file:
        while block := file.read(_BLOCK):
            digest.update(block)
    return digest.hexdigest()


@contextmanager
def open_local_session(location: SessionLocation) -> Iterator[Path]:
    """Provide a session's folder or file locally; a download is deleted when the block ends.

    Raises:
        FileFormatError: it does not exist, or the downloaded frames have another hash.
        StorageError: it cannot be read, or the copy cannot be written.
    """
    if not is_remote(location.uri):
        yield Path(location.uri)
        return
    with create_workspace(SYSTEM_TEMP_FOLDER) as work:
        if location.is_single_file:
            path = work / f"{location.session_id}.parquet"
            download_and_hash(location.uri, path)
            yield path
            return
        folder = work / location.session_id
        folder.mkdir()
        names = sorted(list_file_sizes(location.uri))
        if not names:
            raise FileFormatError("there is no such session", where=location.uri)
        hashes = {
            name: download_and_hash(f"{location.uri}/{name}", folder / name) for name in names
        }
        stated = read_session_metadata(folder).content.get("sha256")
        if stated is not None and hashes.get(FRAMES_NAME, stated) != stated:
            raise DamagedFileError(
                f"the {FRAMES_NAME} received does not have the hash in {SESSION_NAME}",
                where=location.uri,
                remedy="Retry. If the error remains, the store's copy is damaged",
            )
        yield folder


@contextmanager
def open_local_file(uri: str) -> Iterator[Path]:
    """Provide any file locally; with a session's frames, the files beside them.

    Raises:
        FileFormatError: as for `open_local_session`.
        StorageError: as for `open_local_session`.
    """
    place = parse_session_location(uri)
    if not is_remote(uri):
        yield Path(uri)
    elif place.uri != uri:
        with open_local_session(place) as folder:
            yield folder / FRAMES_NAME
    else:
        with create_workspace(SYSTEM_TEMP_FOLDER) as work:
            path = work / uri.rpartition("/")[2]
            download_and_hash(uri, path)
            yield path


def read_session_metadata(folder: Path) -> StoredMetadata:
    """Read the metadata of a session's folder.

    Raises:
        FileFormatError: `session.json` is missing or damaged.
    """
    problems: list[str] = []
    metadata = parse_session_metadata(folder, read_bytes_or_none(folder / SESSION_NAME), problems)
    if problems or metadata is None:
        raise FileFormatError("; ".join(problems), where=str(folder))
    return metadata


def get_sealed_frames_path(session_path: Path) -> Path:
    """Return the path of a sealed session's frames; a single file is returned as it is.

    Raises:
        StateError: the session is not sealed.
        FileFormatError: the frames are missing, or the metadata is damaged.
    """
    if not session_path.is_dir():
        return session_path
    metadata, frames = read_session_metadata(session_path).content, session_path / FRAMES_NAME
    if metadata["state"] != "sealed":
        raise StateError(f"it is {metadata['state']}, and not sealed yet", where=str(session_path))
    if metadata.get("sha256") is None:
        raise FileFormatError("no frame was recorded", where=str(session_path))
    if not frames.is_file() or frames.stat().st_size != metadata["bytes"]:
        raise DamagedFileError(
            f"{FRAMES_NAME} does not match session.json", where=str(session_path)
        )
    return frames


def map_in_threads(
    work: Callable[[_In], _Out], items: Sequence[_In], *, is_remote: bool
) -> Iterator[_Out]:
    """Map a function in order; for a remote store in parallel threads."""
    if not is_remote:
        yield from map(work, items)
        return
    with ThreadPoolExecutor(_MAX_REQUESTS) as pool:
        yield from pool.map(work, items)


def download_and_hash(uri: str, path: Path) -> str:
    """Copy a file to a local path, and return its SHA-256."""
    hash_ = hashlib.sha256()
    with open_for_reading(uri) as source, translate_storage_errors(path), path.open("wb") as file:
        while block := source.read(_BLOCK):
            hash_.update(block)
            file.write(block)
    return hash_.hexdigest()
