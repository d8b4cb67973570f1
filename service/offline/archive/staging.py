"""A session as files of this machine: those that are here, or a copy of what a store has."""

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
"""Under way to a store at the same time."""
_In = TypeVar("_In")
_Out = TypeVar("_Out")


def identity(place: Place) -> str:
    """Hash of what a session says of itself, with the hash of its frames in it.

    Raises:
        FileFormatError: it is not there.
        StorageError: it cannot be read now.
    """
    if place.is_file:
        with reading(place.where) as file:
            said = footer_in(file)
    else:
        said = read_bytes(f"{place.where}/{SESSION_NAME}")
    return hashlib.sha256(said).hexdigest()


def identity_of_file(where: str) -> str:
    """Hash of any file; of a session's frames as for `identity`.

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
    """The session's folder, or its file.

    Raises:
        FileFormatError: it is not there, or what came is not what its hash is of.
        StorageError: it cannot be read, or the copy not be written.
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
                f"the {FRAMES_NAME} that came is not the one that {SESSION_NAME} names",
                where=place.where,
                remedy="Try again; if it stays, the store's copy is damaged",
            )
        yield folder


@contextmanager
def staged_file(where: str) -> Iterator[Path]:
    """Any file; of a session's frames with what lies beside them.

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
    """What a session's folder says of itself.

    Raises:
        FileFormatError: it is not there, or damaged.
    """
    problems: list[str] = []
    said = claims_in(folder, bytes_of(folder / SESSION_NAME), problems, [])
    if problems or said is None:
        raise FileFormatError("; ".join(problems), where=str(folder))
    return said


def frames_of(source: Path) -> Path:
    """The sealed frames of a folder, or the lone file itself.

    Raises:
        StateError: the session is not sealed.
        FileFormatError: there are none, or what it says of itself is damaged.
    """
    if not source.is_dir():
        return source
    said, frames = claims_of(source).content, source / FRAMES_NAME
    if said["state"] != "sealed":
        raise StateError(f"it is {said['state']}, and not sealed yet", where=str(source))
    if said.get("sha256") is None:
        raise FileFormatError("no frame was recorded", where=str(source))
    if not frames.is_file() or frames.stat().st_size != said["bytes"]:
        raise DamagedFileError(f"{FRAMES_NAME} is not the one that it names", where=str(source))
    return frames


def side_by_side(
    work: Callable[[_In], _Out], each: Sequence[_In], *, is_remote: bool
) -> Iterator[_Out]:
    """In order; what waits for a store waits together."""
    if not is_remote:
        yield from map(work, each)
        return
    with ThreadPoolExecutor(_REQUESTS) as pool:
        yield from pool.map(work, each)


def copied(where: str, path: Path) -> str:
    """Copy a file here; its hash."""
    hash_ = hashlib.sha256()
    with reading(where) as source, storage_errors(path), path.open("wb") as file:
        while block := source.read(_BLOCK):
            hash_.update(block)
            file.write(block)
    return hash_.hexdigest()
