"""Sealing of a session to one Parquet file, and rebuilding of its `session.json` from files.

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
from service.sessions.edges import collect_edge_markers
from service.sessions.inputs import SessionFrames, SessionInputs, iterate_warm_up
from service.sessions.overview import OverviewWriter
from service.sessions.stances import StancesWriter
from storage.clock.table import CLOCK_NAME, read_clock_file, write_clock_file
from storage.documents import read_checksummed_json
from storage.durable_files import set_aside_damaged
from storage.parquet_hash import compute_sha256
from storage.sessions.folder import FRAMES_NAME, Ledger, Session, SessionsFolder
from storage.sessions.metadata import (
    MARKERS_NAME,
    SESSION_NAME,
    read_existing_markers,
    write_markers,
    write_sha256_sums,
)
from storage.sessions.warm_up import write_or_delete_warm_up
from storage.sessions.writer import SealedFileWriter
from storage.verify.sealed_file import verify_sealed_file


def write_sealed_files(inputs: SessionInputs, folder: Path, ledger: Ledger) -> Session:
    """Write the session's files; return the sealed session, whose `session.json` the caller saves.

    Args:
        inputs: inputs to seal; every part is closed.
        folder: folder of the session.
        ledger: final ledger.

    Raises:
        FootTileError: the disk is full, or a journal is damaged. The journals are untouched.
    """
    session = inputs.session
    if not ledger.recorded:
        update = {"state": "sealed", "ledger": ledger, "problem": "no frame was recorded"}
        return session.model_copy(update=update)
    warm_up = tuple(iterate_warm_up(inputs))  # read once: more may come
    frames, stances = SessionFrames(inputs, warm_up), StancesWriter()
    overview = OverviewWriter(len(inputs.info.tiles))
    path = folder / FRAMES_NAME
    count = duration_ns = earlier_ns = part_begin_ns = 0
    notes: dict[str, object] = {
        **inputs.notes,
        **write_or_delete_warm_up(folder, inputs.info, warm_up),
        "session": session.model_dump(
            mode="json",
            include=_FIELDS_IN_FILE
            | {name for name in _OPTIONAL_IN_FILE if getattr(session, name)},
        ),
        "ledger": ledger.model_dump(mode="json"),
    }
    last_part = -1
    with SealedFileWriter(path, inputs.info, notes) as writer:
        for batch, columns in frames:
            if not count:
                writer.add_notes_before_first_row_group(frames.notes)
            writer.append_frames(batch, columns)
            stances.try_add_frames(batch.seq, batch.t_ns, columns)
            overview.try_add_frames(batch, columns)
            count += len(batch)
            part = int(columns["part"][0])
            if part != last_part:
                last_part, part_begin_ns = part, int(batch.t_mono_ns[0])
                earlier_ns = duration_ns
            duration_ns = earlier_ns + int(batch.t_mono_ns[-1]) - part_begin_ns
    if count != ledger.recorded:
        raise FileFormatError(
            f"{count} frames were sealed, the ledger has {ledger.recorded}", where=str(path)
        )
    edges = collect_edge_markers(inputs)
    session = session.with_replaced_edges(edges.markers)
    write_markers(session, folder)
    write_clock_file(folder / CLOCK_NAME, session.clock, inputs.stream_facts)
    sha256 = compute_sha256(path)
    write_sha256_sums(folder, sha256)
    stances.try_write_or_delete_file(folder, sha256)
    overview.try_write_file(folder, sha256)
    problems = session.problem, frames.problem, stances.problem, overview.problem, edges.problem
    return session.model_copy(
        update={
            "state": "sealed",
            "problem": "; ".join(filter(None, problems)) or None,
            "ledger": ledger,
            "frames": count,
            "duration_s": duration_ns * 1e-9,
            "bytes": path.stat().st_size,
            "sha256": sha256,
            "calibration_id": frames.notes.get("calibration_id"),
            "absolute_scale": frames.notes.get("absolute_scale"),
        }
    )


_FIELDS_IN_FILE = {"id", "name", "node", "started_t_ns", "stopped_t_ns", "parts", "scene"}
"""Fields of a session in the sealed file; names and notes may change later and are not in it."""
_OPTIONAL_IN_FILE = ("take", "vitals_at_start", "vitals_at_stop")


_T = TypeVar("_T")


def rebuild_damaged_session_json(sessions: SessionsFolder, session_id: str) -> Session | None:
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
        sessions.save_session_json(session)
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
    markers = _read_sidecar(read_existing_markers, folder / MARKERS_NAME)
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
        "duration_s": sum(p.t_mono_ns_last - p.t_mono_ns_first for p in file.parts) * 1e-9,
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
