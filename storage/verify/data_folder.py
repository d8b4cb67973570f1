"""Verification of any path, up to a whole data folder, with one verdict.

Nothing is written, no lock is taken; a server or node may run meanwhile.

Every JSON file of ours has a checksum (`storage.documents`). A name with `.damaged-N` was set aside
and is not verified.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, Literal

from devices.errors import DamagedFileError, FileFormatError, FootTileError, StorageError
from storage.documents import read_checksummed_json
from storage.durable_files import ASIDE_SUFFIX
from storage.journal.segment import INDEX_SUFFIX, SUFFIX
from storage.journal.stream_notes import NOTES_FILE
from storage.sessions.folder import FRAMES_NAME, SESSION_ID, Ledger, SessionsFolder
from storage.sessions.metadata import SESSION_NAME
from storage.verify.journal import SegmentReport, StreamReport, verify_journal, verify_segment
from storage.verify.sealed_file import ExportReport, recognise_export_and_check_not_cut_off
from storage.verify.session import SessionReport, verify_lone_sealed_file, verify_session

Verdict = Literal["complete", "unproven", "lossy", "pending", "damaged", "export"]

_STREAM_NAME = re.compile(r"[0-9a-f]{32}")


@dataclass
class DataFolderReport:
    """Result of the verification of a server's or node's data folder.

    Attributes:
        path: the folder.
        sessions: reports of its sessions, including those in the trash.
        streams: reports of its journals.
        problems: messages of other damage.
        set_aside: files that were found damaged before, and wait for a person.
    """

    path: Path
    sessions: list[SessionReport] = field(default_factory=list)
    streams: list[StreamReport] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    set_aside: list[str] = field(default_factory=list)

    def to_json_dict(self) -> dict[str, Any]:
        """Return the report for JSON (docs/formats.md)."""
        problems, unproven = [*self.problems], []
        for session in self.sessions:
            name = f"session {session.id or session.path.name}"
            problems += [f"{name}: {message}" for message in session.problems]
            unproven += [f"{name}: {message}" for message in session.unproven]
        for stream in self.streams:
            name = f"journal {stream.node}/{stream.stream_id}"
            problems += [f"{name}: {message}" for message in stream.problems]
        return {
            "sessions": [session.to_json_dict() for session in self.sessions],
            "journals": [stream.to_json_dict() for stream in self.streams],
            "problems": problems,
            "unproven": unproven,
            "set_aside": self.set_aside,
        }


Report = DataFolderReport | SessionReport | StreamReport | SegmentReport | ExportReport


def verify_path(path: Path, *, data_folder: Path | None = None) -> Report:
    """Verify a session, sealed file, journal, segment, data folder, or JSON file of ours.

    Args:
        path: a folder or a file.
        data_folder: data folder with the journals of an unsealed session; default: the one around
            it.

    Raises:
        FileFormatError: the path does not exist, or has no file of FootTile.
    """
    if path.is_file():
        if path.suffix in (SUFFIX, INDEX_SUFFIX):
            return verify_segment(path.with_suffix(SUFFIX))
        if path.name == SESSION_NAME:
            return verify_session(path.parent, data_folder=data_folder)
        if path.name == NOTES_FILE:
            return verify_journal(path.absolute().parent)
        if path.suffix == ".json":
            report = DataFolderReport(path)
            _verify_with(read_checksummed_json, path, path.name, report)
            return report
        return recognise_export_and_check_not_cut_off(path) or verify_lone_sealed_file(path)
    if not path.exists():
        raise FileFormatError("no such file or folder", where=str(path))
    if (path / "sessions").is_dir() or (path / "journal").is_dir():
        return verify_data_folder(path)
    if (path / SESSION_NAME).exists() or (path / FRAMES_NAME).exists():
        return verify_session(path, data_folder=data_folder)
    if (path / NOTES_FILE).exists() or any(path.glob("*" + SUFFIX)):
        return verify_journal(path.absolute())
    if any(path.glob("*.json")):
        return verify_data_folder(path)
    raise FileFormatError(
        "foottile wrote none of its files",
        where=str(path),
        expected="a data folder, a session's or a stream's folder, or one of their files",
    )


def verify_data_folder(path: Path) -> DataFolderReport:
    """Verify a data folder: every session and every journal in it.

    Raises:
        FileFormatError: it cannot be read.
    """
    data = path.absolute()
    report = DataFolderReport(path)
    verify_once = cache(verify_journal)
    proven: set[Path] = set()
    for folder in _find_folders(data, "journal/*", _STREAM_NAME, report):
        proven.add(folder)
        with _report_errors(report, folder, data):
            report.streams.append(verify_once(folder))
    for place in ("sessions", "trash"):
        for folder in _find_folders(data, place, SESSION_ID, report):
            proven.add(folder)
            with _report_errors(report, folder, data):
                # The folder of a session that was never saved is empty.
                if any(not inside.name.startswith(".") for inside in folder.iterdir()):
                    session = verify_session(
                        folder, data_folder=data, verify_stream_journal=verify_once
                    )
                    if session.id not in (None, folder.name):
                        session.problems.append(f"it lies in the folder of {folder.name}")
                    report.sessions.append(session)
        for stray in SessionsFolder(data / place).find_renamed_or_copied_sessions():
            folder = data / place / stray.name
            proven.add(folder)
            with _report_errors(report, folder, data):
                session = verify_session(
                    folder, data_folder=data, verify_stream_journal=verify_once
                )
                session.problems.append(f"{place}/{stray.name}: {stray.error.what}")
                report.sessions.append(session)
    _verify_documents(data, proven, report)
    return report


def _verify_documents(
    data_folder: Path, verified_folders: set[Path], report: DataFolderReport
) -> None:
    """Verify every document of a data folder, except in folders done elsewhere.

    Token, locks and other files have no checksum.

    Args:
        data_folder: the data folder.
        verified_folders: folders of streams and sessions, whose set-aside files only are listed.
        report: findings are added here.
    """

    def unreadable(error: OSError) -> None:
        name = os.path.relpath(error.filename, data_folder)
        report.problems.append(f"{name}: cannot be read: {error.strerror}")

    for place, folders, files in os.walk(data_folder, onerror=unreadable):
        here = Path(place)
        folders.sort()
        is_verified = here in verified_folders
        for name in sorted([*folders, *files]):
            path = here / name
            if ASIDE_SUFFIX in name:
                report.set_aside.append(os.path.relpath(path, data_folder))
            elif name.endswith(".json") and not name.startswith(".") and not is_verified:
                relative = os.path.relpath(path, data_folder)
                _verify_with(read_checksummed_json, path, relative, report)
        # A folder that was set aside, or that has the name of a file, is skipped.
        folders[:] = [
            name for name in folders if ASIDE_SUFFIX not in name and not name.endswith(".json")
        ]
        if is_verified:
            folders.clear()


def _verify_with(
    read: Callable[[Path], object], path: Path, name: str, report: DataFolderReport
) -> None:
    """Read a file, and add any damage to the report, under `name`."""
    try:
        read(path)
    except FileNotFoundError:
        return  # replaced or deleted meanwhile
    except (DamagedFileError, StorageError) as error:
        report.problems.append(f"{name}: {error.what}")


def _find_folders(
    data: Path, pattern: str, name_pattern: re.Pattern[str], report: DataFolderReport
) -> Iterator[Path]:
    """Yield folders with a name of this form; report other files with such a name as problems.

    A link in place of the folder of all sessions, or all journals, is followed.
    """
    for path in sorted(data.glob(f"{pattern}/*")):
        if ASIDE_SUFFIX in path.name or not name_pattern.fullmatch(path.name):
            continue
        with _report_errors(report, path, data):
            if path.is_symlink() or (path.parent.is_symlink() and path.parent.parent != data):
                what = "it is a link, or in one: links are not followed"
                report.problems.append(f"{path.relative_to(data)}: {what}")
            elif path.is_dir():
                yield path
            else:
                report.problems.append(f"{path.relative_to(data)}: it is not a folder")


@contextmanager
def _report_errors(report: DataFolderReport, path: Path, data: Path) -> Iterator[None]:
    """Context manager: report any error as a problem and go on; a deleted path is none.

    Damaged bytes may cause any error, and none may hide other damage.
    """
    try:
        yield
    except Exception as error:
        if os.path.lexists(path):
            what = error.what if isinstance(error, FootTileError) else f"cannot be read: {error}"
            report.problems.append(f"{path.relative_to(data)}: {what}")


def find_verdict(report: Report) -> Verdict:
    """Return the worst finding.

    Frames of a journal that no session needs may be deleted: that is no loss.
    """
    if report.problems:
        return "damaged"
    if isinstance(report, ExportReport):
        return "export"
    verdicts: set[Verdict] = set()
    if isinstance(report, DataFolderReport):
        parts: list[Report] = [*report.sessions, *report.streams]
        verdicts = {find_verdict(part) for part in parts}
    elif isinstance(report, SessionReport) and not report.is_in_trash:
        verdicts = {_ledger_verdict(report.ledger)}
    if isinstance(report, SessionReport) and report.unproven:
        verdicts.add("unproven")
    order: tuple[Verdict, ...] = ("damaged", "pending", "lossy", "unproven")
    return next((verdict for verdict in order if verdict in verdicts), "complete")


def _ledger_verdict(ledger: Ledger | None) -> Verdict:
    if ledger is None or any(part.pending for part in ledger.parts):
        return "pending"
    if ledger.lossy:
        return "lossy"
    return "complete" if ledger.complete else "pending"
