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
from storage.checksummed_json import read_checksummed_json
from storage.clock.file import CLOCK_NAME, read_clock_file
from storage.durable_files import set_aside_damaged
from storage.parquet_hash import compute_sha256
from storage.sessions.folder import FRAMES_NAME, Session, SessionsFolder
from storage.sessions.metadata import SESSION_NAME
from storage.sessions.sidecars import MARKERS_NAME, read_markers
from storage.verify.sealed_file import SealedFileReport, verify_sealed_file

_T = TypeVar("_T")


def rebuild_session(sessions: SessionsFolder, session_id: str) -> Session | None:
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
    folder = sessions.get_path(session_id)
    path = folder / SESSION_NAME
    try:
        read_checksummed_json(path)
    except FileNotFoundError:
        what = f"its {SESSION_NAME} was gone"
    except StorageError:
        return None
    except DamagedFileError:
        what = f"its {SESSION_NAME} was damaged"
    else:
        return None  # intact, but of another version
    session = _session_from_files(folder, what)
    if session is not None:
        if path.exists() or path.is_symlink():
            set_aside_damaged(path)
        sessions.save(session)
    return session


def _session_from_files(folder: Path, what: str) -> Session | None:
    path = folder / FRAMES_NAME
    if not path.is_file():
        return None
    try:
        file = verify_sealed_file(path)
    except FileFormatError:
        return None
    notes = file.notes
    if file.problems or file.session.get("id") != folder.name:
        return None
    lost = ["subject, notes and tags"]
    markers = _read_sidecar(read_markers, folder / MARKERS_NAME)
    if markers is None:
        lost.append("markers")
    clock = _read_sidecar(read_clock_file, folder / CLOCK_NAME)
    if clock is None:
        lost.append("clock measurements")
    content = {
        **file.session,
        "state": "sealed",
        "scene_content": notes.get("scene") or {},
        "calibration": notes.get("calibration"),
        "calibration_source": notes.get("calibration_source", "node"),
        "markers": markers or (),
        "clock": clock.offsets if clock is not None else (),
        "problem": f"{what} and was rebuilt from {FRAMES_NAME}; lost are {', '.join(lost)}",
        "ledger": file.ledger,
        "frames": file.frame_count,
        "duration_s": _duration_s(file),
        "bytes": path.stat().st_size,
        "sha256": compute_sha256(path),
        "calibration_id": notes.get("calibration_id"),
        "absolute_scale": notes.get("absolute_scale"),
    }
    try:
        return Session.model_validate(content)
    except ValidationError:
        return None


def _read_sidecar(read: Callable[[Path], _T], path: Path) -> _T | None:
    try:
        return read(path)
    except (FileNotFoundError, FileFormatError):
        return None


def _duration_s(file: SealedFileReport) -> float:
    return sum(part.t_mono_ns_last - part.t_mono_ns_first for part in file.parts) * 1e-9
