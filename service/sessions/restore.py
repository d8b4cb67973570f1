"""Rebuilding of a damaged or missing `session.json` of a sealed session from the files beside it.

The sealed file has the session's id, parts and ledger, with a checksum; so have markers and clock.
Subject, notes and tags, which only `session.json` had, are lost, and the session reports that. For
an unsealed session no other file has its needed frames: its folder is left unchanged.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from pydantic import ValidationError

from devices.errors import DamagedFileError, FileFormatError, StorageError
from storage.checked_json import read_checked
from storage.clock.file import CLOCK_NAME, read_clock
from storage.durable import set_aside
from storage.file_hash import sha256_of
from storage.sessions.beside import EVENTS_NAME, read_events
from storage.sessions.claims import SESSION_NAME
from storage.sessions.folder import FRAMES_NAME, Session, SessionFolder
from storage.verify.file import FileReport, verify_file

_T = TypeVar("_T")


def restore(sessions: SessionFolder, session_id: str) -> Session | None:
    """Set a damaged `session.json` aside, and rebuild it.

    Args:
        sessions: folder of the session; the caller holds the lock of the data folder.
        session_id: id of a session that cannot be read.

    Returns:
        Session; None if no file proves its content, if it is of another version, or if its
        `session.json` cannot be read now.

    Raises:
        StorageError: a file beside it cannot be read now, or the disk is full or not writable.
    """
    folder = sessions.path(session_id)
    path = folder / SESSION_NAME
    try:
        if read_checked(path).is_proven:
            return None  # intact, but of another version
    except FileNotFoundError:
        what = f"its {SESSION_NAME} was gone"
    except StorageError:
        return None
    except DamagedFileError:
        what = f"its {SESSION_NAME} was damaged"
    else:
        what = f"its {SESSION_NAME} was not readable"
    session = _session_of(folder, what)
    if session is not None:
        if path.exists() or path.is_symlink():
            set_aside(path)
        sessions.save(session)
    return session


def _session_of(folder: Path, what: str) -> Session | None:
    path = folder / FRAMES_NAME
    if not path.is_file():
        return None
    try:
        file = verify_file(path)
    except FileFormatError:
        return None
    notes = file.notes
    if file.problems or file.content_sha256 is None or file.session.get("id") != folder.name:
        return None
    lost = ["subject, notes and tags"]
    events = _beside(read_events, folder / EVENTS_NAME)
    if events is None:
        lost.append("marks")
    clock = _beside(read_clock, folder / CLOCK_NAME)
    if clock is None:
        lost.append("clock measurements")
    content = {
        **file.session,
        "state": "sealed",
        "scene_content": notes.get("scene") or {},
        "calibration": notes.get("calibration"),
        "calibration_source": notes.get("calibration_source", "node"),
        "events": events.events if events is not None else (),
        "clock": clock.offsets if clock is not None else (),
        "problem": f"{what} and was rebuilt from {FRAMES_NAME}; lost are {', '.join(lost)}",
        "ledger": file.ledger,
        "frames": file.frames,
        "duration_s": _duration_s(file),
        "bytes": path.stat().st_size,
        "sha256": sha256_of(path),
        "calibration_id": notes.get("calibration_id"),
        "absolute_scale": notes.get("absolute_scale"),
    }
    try:
        return Session.model_validate(content)
    except ValidationError:
        return None


def _beside(read: Callable[[Path], _T], path: Path) -> _T | None:
    try:
        return read(path)
    except (FileNotFoundError, FileFormatError):
        return None


def _duration_s(file: FileReport) -> float:
    return sum(part.t_mono_ns_last - part.t_mono_ns_first for part in file.parts) * 1e-9
