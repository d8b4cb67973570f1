"""Search for sealed sessions, with the reason for each one left out.

A session is accepted if the checksum of its `session.json` is right and its frames file has the
length stated there.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from devices.errors import FootTileError
from service.offline.archive.places import (
    Place,
    check_text,
    is_remote,
    read_bytes,
    sessions_in,
    sizes_in,
)
from service.offline.archive.sealed import Archive, Archived
from service.offline.archive.staging import side_by_side
from storage.durable import write_whole
from storage.sessions.claims import (
    LEDGER_NAME,
    PULLED_EVENTS_NAME,
    SESSION_NAME,
    bytes_of,
    claims_in,
)
from storage.sessions.folder import FRAMES_NAME


def find_sessions(places: Sequence[str], mirror: Path | None = None) -> Archive:
    """Find all sealed sessions at some locations.

    Args:
        places: paths, globs or URIs; see `service.offline.archive.places`.
        mirror: empty folder for metadata copied from object stores; required for
            remote sessions.

    Raises:
        UsageError: a location does not exist.
        StorageError: a store does not answer.
    """
    found = Archive()
    seen: dict[str, Place] = {}
    every = sorted(sessions_in(places), key=lambda place: place.name)
    waits = any(is_remote(place.where) for place in every)
    looked = side_by_side(partial(_looked_at, mirror=mirror), every, is_remote=waits)
    for place, (reason, session) in zip(every, looked, strict=True):
        other = seen.get(place.name)
        if session is None:
            found.left_out[place.where] = reason
        elif other is not None:
            if not _are_same(place.where, other.where):
                found.left_out[place.where] = f"it is also in {other.where}"
        else:
            seen[place.name] = place
            found.sessions.append(session)
    return found


def _are_same(one: str, other: str) -> bool:
    if is_remote(one) or is_remote(other):
        return one == other
    return os.path.samefile(one, other)


def _looked_at(place: Place, mirror: Path | None) -> tuple[str, Archived | None]:
    """Return the session; or, with None, the reason to leave it out."""
    if place.is_file:
        return "it is a single file, not a session's folder", None
    try:
        check_text(place)
    except FootTileError as error:
        return error.what, None
    folder, sizes = Path(place.where), None
    if is_remote(place.where):
        if mirror is None:
            raise ValueError("remote sessions need a folder for downloads")
        folder = mirror / hashlib.sha256(place.where.encode()).hexdigest()[:16] / place.name
        try:
            sizes = sizes_in(place.where)
            folder.mkdir(parents=True, exist_ok=True)
            for name in (SESSION_NAME, LEDGER_NAME, PULLED_EVENTS_NAME):
                if name in sizes:
                    write_whole(folder / name, read_bytes(f"{place.where}/{name}"))
        except FootTileError as error:
            return str(error), None
    problems: list[str] = []
    metadata = claims_in(folder, bytes_of(folder / SESSION_NAME), problems, [])
    if problems or metadata is None:
        return f"damaged: {'; '.join(problems)}", None
    content = metadata.content
    if content["id"] != place.name:
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
    return "", Archived(place, folder, metadata)
