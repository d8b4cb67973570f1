"""Sealing of a session: journals to one Parquet file, its sidecars, and the ledger."""

from __future__ import annotations

from pathlib import Path

from devices.errors import FileFormatError
from service.sessions.frames import SessionFrames
from service.sessions.inputs import SessionInputs
from service.sessions.overview import OverviewWriter
from service.sessions.stances import StancesWriter
from storage.clock.file import CLOCK_NAME, write_clock_file
from storage.parquet_hash import compute_sha256
from storage.sessions.folder import FRAMES_NAME, Ledger, Session
from storage.sessions.sidecars import write_markers
from storage.sessions.writer import SealedFileWriter


def seal_session(inputs: SessionInputs, folder: Path, ledger: Ledger) -> Session:
    """Write the session's files; return the sealed session.

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
    frames, stances = SessionFrames(inputs), StancesWriter()
    overview = OverviewWriter(len(inputs.info.tiles))
    path = folder / FRAMES_NAME
    count = duration_ns = earlier_ns = part_begin_ns = 0
    notes: dict[str, object] = {
        **inputs.notes,
        "session": session.model_dump(
            mode="json", include=_FIELDS_IN_FILE | ({"take"} if session.take else set())
        ),
        "ledger": ledger.model_dump(mode="json"),
    }
    last_part = -1
    with SealedFileWriter(path, inputs.info, notes) as writer:
        for batch, columns in frames:
            if not count:
                writer.add_notes(frames.notes)
            writer.append_frames(batch, columns)
            stances.add_frames(batch.seq, batch.t_ns, columns)
            overview.add_frames(batch, columns)
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
    write_markers(session, folder)
    write_clock_file(folder / CLOCK_NAME, session.clock, inputs.stream_facts)
    sha256 = compute_sha256(path)
    stances.try_write_or_delete_file(folder, sha256)
    overview.try_write_file(folder, sha256)
    problems = session.problem, frames.problem, stances.problem, overview.problem
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
