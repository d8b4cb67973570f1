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


def find_sessions(locations: Sequence[str], download_folder: Path | None = None) -> SessionArchive:
    """Find all sealed sessions at some locations.

    Args:
        locations: paths, globs or URIs; see `service.offline.archive.places`.
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
