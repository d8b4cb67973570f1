"""Local copies of sessions and files in object stores; local ones are used in place."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from devices.errors import DamagedFileError, FileFormatError, StateError
from service.offline.archive.places import (
    Place,
    is_remote,
    place_of,
    read_bytes,
    reading,
    sizes_in,
)
from service.offline.archive.workspace import SYSTEM, workspace
from storage.durable import storage_errors
from storage.file_hash import footer_in
from storage.sessions.claims import SESSION_NAME, Claims, bytes_of, claims_in
from storage.sessions.folder import FRAMES_NAME

_BLOCK = 1 << 20
_REQUESTS = 16
"""Concurrent requests to a store."""
_In = TypeVar("_In")
_Out = TypeVar("_Out")


def identity(place: Place) -> str:
    """Hash a session's `session.json`, which contains the hash of its frames.

    Raises:
        FileFormatError: it is not there.
        StorageError: it cannot be read now.
    """
    if place.is_file:
        with reading(place.where) as file:
            metadata = footer_in(file)
    else:
        metadata = read_bytes(f"{place.where}/{SESSION_NAME}")
    return hashlib.sha256(metadata).hexdigest()


def identity_of_file(where: str) -> str:
    """Hash any file; for a session's frames, return `identity` of the session.

    Raises:
        FileFormatError: it is not there.
        StorageError: it cannot be read now.
    """
    place = place_of(where)
    if place.where != where:
        return identity(place)
    digest = hashlib.sha256()
    with reading(where) as file:
        while block := file.read(_BLOCK):
            digest.update(block)
    return digest.hexdigest()


@contextmanager
def staged(place: Place) -> Iterator[Path]:
    """Provide a session's folder or file locally; a download is deleted when the block ends.

    Raises:
        FileFormatError: it does not exist, or the downloaded frames have another hash.
        StorageError: it cannot be read, or the copy cannot be written.
    """
    if not is_remote(place.where):
        yield Path(place.where)
        return
    with workspace(SYSTEM) as work:
        if place.is_file:
            path = work / f"{place.name}.parquet"
            copied(place.where, path)
            yield path
            return
        folder = work / place.name
        folder.mkdir()
        names = sorted(sizes_in(place.where))
        if not names:
            raise FileFormatError("there is no such session", where=place.where)
        hashes = {name: copied(f"{place.where}/{name}", folder / name) for name in names}
        stated = claims_of(folder).content.get("sha256")
        if stated is not None and hashes.get(FRAMES_NAME, stated) != stated:
            raise DamagedFileError(
                f"the {FRAMES_NAME} received does not have the hash in {SESSION_NAME}",
                where=place.where,
                remedy="Retry. If the error remains, the store's copy is damaged",
            )
        yield folder


@contextmanager
def staged_file(where: str) -> Iterator[Path]:
    """Provide any file locally; with a session's frames, the files beside them.

    Raises:
        FileFormatError: as for `staged`.
        StorageError: as for `staged`.
    """
    place = place_of(where)
    if not is_remote(where):
        yield Path(where)
    elif place.where != where:
        with staged(place) as folder:
            yield folder / FRAMES_NAME
    else:
        with workspace(SYSTEM) as work:
            path = work / where.rpartition("/")[2]
            copied(where, path)
            yield path


def claims_of(folder: Path) -> Claims:
    """Read the metadata of a session's folder.

    Raises:
        FileFormatError: `session.json` is missing or damaged.
    """
    problems: list[str] = []
    metadata = claims_in(folder, bytes_of(folder / SESSION_NAME), problems, [])
    if problems or metadata is None:
        raise FileFormatError("; ".join(problems), where=str(folder))
    return metadata


def frames_of(source: Path) -> Path:
    """Return the path of a sealed session's frames; a single file is returned as it is.

    Raises:
        StateError: the session is not sealed.
        FileFormatError: the frames are missing, or the metadata is damaged.
    """
    if not source.is_dir():
        return source
    metadata, frames = claims_of(source).content, source / FRAMES_NAME
    if metadata["state"] != "sealed":
        raise StateError(f"it is {metadata['state']}, and not sealed yet", where=str(source))
    if metadata.get("sha256") is None:
        raise FileFormatError("no frame was recorded", where=str(source))
    if not frames.is_file() or frames.stat().st_size != metadata["bytes"]:
        raise DamagedFileError(f"{FRAMES_NAME} does not match session.json", where=str(source))
    return frames


def side_by_side(
    work: Callable[[_In], _Out], each: Sequence[_In], *, is_remote: bool
) -> Iterator[_Out]:
    """Map a function in order; for a remote store in parallel threads."""
    if not is_remote:
        yield from map(work, each)
        return
    with ThreadPoolExecutor(_REQUESTS) as pool:
        yield from pool.map(work, each)


def copied(where: str, path: Path) -> str:
    """Copy a file to a local path, and return its SHA-256."""
    hash_ = hashlib.sha256()
    with reading(where) as source, storage_errors(path), path.open("wb") as file:
        while block := source.read(_BLOCK):
            hash_.update(block)
            file.write(block)
    return hash_.hexdigest()
