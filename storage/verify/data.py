"""Verifies whatever a path names, up to a whole data folder, and gives one verdict.

Nothing is written, no lock is taken; a server or node may run beside it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, Literal

from devices.errors import FileFormatError
from storage.journal.segment import SUFFIX
from storage.journal.segment_format import INDEX_SUFFIX
from storage.journal.stream_notes import NOTES_FILE
from storage.sessions.claims import SESSION_NAME
from storage.sessions.folder import FRAMES_NAME
from storage.verify.journal import StreamReport, verify_stream
from storage.verify.segment import SegmentReport, verify_segment
from storage.verify.session import SessionReport, verify_lone_file, verify_session

Verdict = Literal["complete", "lossy", "pending", "damaged"]


@dataclass
class FolderReport:
    """What the data folder of a server or node proves.

    Attributes:
        path: the folder.
        sessions: of its sessions, including those in the trash.
        streams: of its journals.
        problems: what is wrong beside these.
    """

    path: Path
    sessions: list[SessionReport] = field(default_factory=list)
    streams: list[StreamReport] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)

    def as_dict(self) -> dict[str, Any]:
        """As JSON has it (docs/formats.md)."""
        sessions, streams = self.sessions, self.streams
        everything = [
            *self.problems,
            *(f"session {s.id or s.path.name}: {said}" for s in sessions for said in s.problems),
            *(f"journal {j.node}/{j.boot_id}: {said}" for j in streams for said in j.problems),
        ]
        return {
            "sessions": [session.as_dict() for session in sessions],
            "journals": [stream.as_dict() for stream in streams],
            "problems": everything,
        }


Report = FolderReport | SessionReport | StreamReport | SegmentReport


def verify(path: Path, *, data: Path | None = None) -> Report:
    """Prove what is there, whatever it is: session, sealed file, journal, segment, data folder.

    Args:
        path: a folder or a file.
        data: data folder with the journals of a session that is not sealed; default: around it.

    Raises:
        FileFormatError: nothing is there, or nothing that FootTile wrote.
    """
    if path.is_file():
        if path.suffix in (SUFFIX, INDEX_SUFFIX):
            return verify_segment(path.with_suffix(SUFFIX))
        if path.name == SESSION_NAME:
            return verify_session(path.parent, data=data)
        if path.name == NOTES_FILE:
            return verify_stream(path.absolute().parent)
        return verify_lone_file(path)
    if not path.exists():
        raise FileFormatError("no such file or folder", where=str(path))
    if (path / "sessions").is_dir() or (path / "journal").is_dir():
        return verify_folder(path)
    if (path / SESSION_NAME).exists() or (path / FRAMES_NAME).exists():
        return verify_session(path, data=data)
    if (path / NOTES_FILE).exists() or any(path.glob("*" + SUFFIX)):
        return verify_stream(path.absolute())
    raise FileFormatError(
        "nothing that foottile wrote is in it",
        where=str(path),
        expected="a data folder, a session's or a stream's folder, or one of their files",
    )


def verify_folder(path: Path) -> FolderReport:
    """Prove a data folder: every session and every journal in it.

    Raises:
        FileFormatError: it cannot be read.
    """
    report = FolderReport(path)
    known = cache(verify_stream)
    for folder in sorted(path.absolute().glob("journal/*/*")):
        if folder.is_dir() and (report_of := _if_there(folder, known)) is not None:
            report.streams.append(report_of)
    for place in ("sessions", "trash"):
        for folder in _session_folders(path / place):
            try:
                session = verify_session(folder, data=path.absolute(), streams=known)
            except FileFormatError:
                if folder.exists():
                    raise
                continue  # deleted meanwhile
            if session.id not in (None, folder.name):
                session.problems.append(f"it lies in the folder of {folder.name}")
            report.sessions.append(session)
    return report


def verdict_of(report: Report) -> Verdict:
    """The worst of what was found.

    Frames of a journal that no session needs may be deleted: that is no loss.
    """
    if isinstance(report, FolderReport):
        parts: list[Report] = [*report.sessions, *report.streams]
        verdicts = {verdict_of(part) for part in parts}
        if report.problems:
            return "damaged"
        order: tuple[Verdict, ...] = ("damaged", "pending", "lossy")
        return next((verdict for verdict in order if verdict in verdicts), "complete")
    if report.problems:
        return "damaged"
    if not isinstance(report, SessionReport) or report.in_trash:
        return "complete"
    if report.ledger is None or any(part.pending for part in report.ledger.parts):
        return "pending"
    if report.ledger.lossy:
        return "lossy"
    return "complete" if report.ledger.complete else "pending"


def _session_folders(place: Path) -> list[Path]:
    if not place.is_dir():
        return []
    # The folder of a session that was never written down is empty.
    return sorted(
        path
        for path in place.iterdir()
        if path.is_dir() and any(not inside.name.startswith(".") for inside in path.iterdir())
    )


def _if_there(folder: Path, known: Any) -> StreamReport | None:
    try:
        report: StreamReport = known(folder)
    except FileFormatError:
        if folder.exists():
            raise
        return None
    return report
