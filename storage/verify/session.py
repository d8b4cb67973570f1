"""Verification of a session's folder by its files: description, frames, markers, clock, videos.

Nothing is written and no lock is needed: a server may run meanwhile. If the session changes during
a check that finds problems, the check is repeated.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from devices.errors import DamagedFileError, FileFormatError, OtherVersionError, StorageError
from storage.clock.table import CLOCK_NAME, read_clock_file
from storage.intervals import NO_END, Intervals
from storage.parquet_hash import compute_sha256
from storage.sessions.folder import FRAMES_NAME, WARM_UP_NAME, Ledger, Marker, Session
from storage.sessions.ledger import compute_ledger, mark_damaged_and_abandoned_lost
from storage.sessions.metadata import (
    MARKERS_NAME,
    SESSION_NAME,
    SUMS_NAME,
    StoredMetadata,
    format_sha256_sums,
    parse_session_metadata,
    read_bytes_or_none,
    read_existing_markers,
    wrap_session_as_metadata,
)
from storage.sessions.overview import OVERVIEW_NAME, open_overview
from storage.sessions.stances import STANCES_NAME, read_stances
from storage.sessions.videos import verify_videos
from storage.sessions.warm_up import read_warm_up
from storage.verify.journal import StreamReport, verify_journal
from storage.verify.sealed_file import (
    SealedFileReport,
    find_ledger_contradictions,
    verify_sealed_file,
)

_MAX_ATTEMPTS = 3
_DURATION_TOLERANCE_S = 1e-6

StreamVerifier = Callable[[Path], StreamReport]
_T = TypeVar("_T")


@dataclass
class SessionReport:
    """Result of the verification of a session's folder, or of a sealed file.

    Attributes:
        path: the folder or file.
        id: id of the session; None if it cannot be read, or if the file is of no session.
        name: name of the session.
        node: name of its node.
        state: state in its metadata; `file` for a lone file.
        ledger: its ledger; None if that cannot be read.
        sha256: hash of the sealed file; None if it is not sealed.
        problems: messages of damage; empty: it is undamaged.
        unproven: facts that these files cannot prove.
        is_in_trash: True: it is in the trash.
    """

    path: Path
    id: str | None = None
    name: str = ""
    node: str = ""
    state: str = ""
    ledger: Ledger | None = None
    sha256: str | None = None
    problems: list[str] = field(default_factory=list)
    unproven: list[str] = field(default_factory=list)
    is_in_trash: bool = False

    def to_json_dict(self) -> dict[str, Any]:
        """Return ledger and findings for JSON (docs/formats.md)."""
        ledger = self.ledger or Ledger(complete=False, lossy=False, parts=(), missed_slots=0)
        return {
            **ledger.model_dump(mode="json"),
            "complete": ledger.complete and not self.problems,
            "id": self.id,
            "problems": self.problems,
            "sha256": self.sha256,
            "unproven": self.unproven,
        }


def verify_lone_sealed_file(path: Path) -> SessionReport:
    """Verify a sealed file without `session.json` beside it.

    Raises:
        FileFormatError: there is no such file, or it is no sealed session.
    """
    file = verify_sealed_file(path)
    report = SessionReport(path, state="file", ledger=file.ledger, sha256=compute_sha256(path))
    report.id, report.node = file.session.get("id"), str(file.session.get("node", ""))
    report.name = str(file.session.get("name", ""))
    report.problems, report.unproven = file.problems, file.unproven
    if report.id is not None:
        report.unproven.append(
            f"that it is the file in {SESSION_NAME} of its session, nor events and clock"
        )
    return report


def verify_session(
    folder: Path,
    *,
    data_folder: Path | None = None,
    expected_session: Session | None = None,
    verify_stream_journal: StreamVerifier = verify_journal,
) -> SessionReport:
    """Verify a session's folder.

    Args:
        folder: folder with `session.json`, and `frames.parquet` if it is sealed.
        data_folder: data folder with its journals if it is not sealed; default: a server's layout.
        expected_session: model to verify the files against, in place of `session.json`.
        verify_stream_journal: verifies a stream's journal.

    Raises:
        FileFormatError: there is no such folder.
    """
    if not folder.is_dir():
        raise FileFormatError("no such folder", where=str(folder))
    data_folder = data_folder if data_folder is not None else folder.absolute().parent.parent
    for _ in range(_MAX_ATTEMPTS):
        before = read_bytes_or_none(folder / SESSION_NAME)
        report = _verify_once(folder, data_folder, expected_session, before, verify_stream_journal)
        if not report.problems or before == read_bytes_or_none(folder / SESSION_NAME):
            break
    return report


def _verify_once(
    folder: Path, data: Path, session: Session | None, text: bytes | None, streams: StreamVerifier
) -> SessionReport:
    report = SessionReport(folder, is_in_trash=folder.absolute().parent.name == "trash")
    metadata = (
        wrap_session_as_metadata(session)
        if session is not None
        else parse_session_metadata(folder, text, report.problems)
    )
    if metadata is None:
        if (folder / FRAMES_NAME).is_file():
            _verify_frames(report, folder)
        return report
    report.id, report.name = str(metadata.content["id"]), str(metadata.content.get("name", ""))
    report.node = str(metadata.content.get("node", ""))
    report.state = str(metadata.content.get("state"))
    report.ledger = metadata.ledger
    if report.state == "sealed":
        _check_sealed(report, folder, metadata)
        report.problems += verify_videos(folder)
    elif metadata.session is not None:
        _count_ledger(report, data, metadata.session, streams)
    return report


def _check_sealed(report: SessionReport, folder: Path, metadata: StoredMetadata) -> None:
    problems, content = report.problems, metadata.content
    if metadata.ledger is None:
        problems.append("it is sealed, but its ledger is missing")
    elif any(part.pending for part in metadata.ledger.parts):
        problems.append("it is sealed, but frames are still to come")
    path = folder / FRAMES_NAME
    if metadata.ledger is not None and not any(part.recorded for part in metadata.ledger.parts):
        if path.is_file():
            problems.append(f"{FRAMES_NAME} exists, but the ledger has no frame recorded")
        problems += find_ledger_contradictions(metadata.ledger)
        return
    if not path.is_file():
        problems.append(f"{FRAMES_NAME} is missing")
        return
    file = _verify_frames(report, folder)
    if report.sha256 == content.get("sha256"):
        _compare_metadata(problems, metadata, file, path.stat().st_size)
    elif not file.problems:
        problems.append(
            f"{FRAMES_NAME} is not the file that {SESSION_NAME} names: it is of session "
            f"{file.session.get('id', 'none')}, and its SHA-256 is {report.sha256}, not "
            f"{content.get('sha256')}"
        )
    report.ledger = metadata.ledger or report.ledger
    session = metadata.session
    _check_events(report, folder / MARKERS_NAME, session.markers if session is not None else None)
    _check_clock(report, folder / CLOCK_NAME, session)
    _check_warm_up(report, file.notes)
    _check_sums(problems, folder, str(content.get("sha256")))
    stances, overview = folder / STANCES_NAME, folder / OVERVIEW_NAME
    _check_derived_file(report, stances, lambda path: read_stances(path).frames_sha256)
    _check_derived_file(report, overview, _read_overview_frames_sha256)


def _check_sums(problems: list[str], folder: Path, frames_sha256: str) -> None:
    """Compare `SHA256SUMS`, if there is one, with files that have no problem themselves."""
    path = folder / SUMS_NAME
    if problems or not os.path.lexists(path):
        return
    try:
        is_true = read_bytes_or_none(path) == format_sha256_sums(folder, frames_sha256)
    except OSError as error:
        problems.append(f"{CLOCK_NAME}: cannot be read: {error.strerror}")
        return
    if not is_true:
        problems.append(f"{SUMS_NAME} has other hashes than the files")


def _compare_metadata(
    problems: list[str], metadata: StoredMetadata, file: SealedFileReport, size: int
) -> None:
    """Compare the file's facts in `session.json` with the file."""
    content = metadata.content
    first_last = [(part.t_mono_ns_first, part.t_mono_ns_last) for part in file.parts]
    duration_s = sum(last - first for first, last in first_last) * 1e-9
    found: dict[str, Any] = {"frames": file.frame_count, "bytes": size}
    found |= {
        name: file.session.get(name)
        for name in ("id", "node", "started_t_ns", "stopped_t_ns", "scene")
        if name in file.session
    }
    found |= {name: file.notes.get(name) for name in ("calibration_id", "absolute_scale")}
    for name, value in found.items():
        if name in content and content[name] != value:
            problems.append(
                f"{SESSION_NAME} says {name} {content[name]!r}, and {FRAMES_NAME} {value!r}"
            )
    if not file.session:
        problems.append(f"{FRAMES_NAME} is of no recorded session")
    if abs(float(content.get("duration_s", duration_s)) - duration_s) > _DURATION_TOLERANCE_S:
        problems.append(
            f"{SESSION_NAME} says that it lasted {content['duration_s']} s, and {FRAMES_NAME} "
            f"{duration_s} s"
        )
    if None not in (metadata.ledger, file.ledger) and file.ledger != metadata.ledger:
        problems.append(f"the ledgers of {SESSION_NAME} and {FRAMES_NAME} are not the same")
    if file.session and file.session.get("parts") != [p.model_dump() for p in metadata.parts]:
        problems.append(f"{SESSION_NAME} and {FRAMES_NAME} are not of the same parts")


def _verify_frames(report: SessionReport, folder: Path) -> SealedFileReport:
    """Verify the frames, and add the findings to the report, damage of the file as one."""
    path = folder / FRAMES_NAME
    try:
        file = verify_sealed_file(path)
        report.sha256 = compute_sha256(path)
    except (FileFormatError, OSError) as error:
        what = error.what if isinstance(error, FileFormatError) else str(error)
        file = SealedFileReport(path, [what])
    if file.problems:
        report.problems.append(f"{FRAMES_NAME}: {'; '.join(file.problems)}")
    report.unproven += file.unproven
    report.id = report.id if report.id is not None else file.session.get("id")
    report.ledger = report.ledger or file.ledger
    return file


def _check_events(report: SessionReport, path: Path, events: tuple[Marker, ...] | None) -> None:
    """Verify the table of markers.

    Args:
        report: findings are added here.
        path: the table.
        events: expected markers; None: unknown, and the table may be missing.
    """
    stored = _read_sidecar(report, path, read_existing_markers, is_optional=events is None)
    if stored is not None and events is not None and stored != events:
        report.problems.append(f"{path.name} has other events than {SESSION_NAME}")


def _check_clock(report: SessionReport, path: Path, session: Session | None) -> None:
    """Verify the clock table."""
    stored = _read_sidecar(report, path, read_clock_file, is_optional=session is None)
    if stored is None or session is None:
        return
    by_stream = sorted(session.clock, key=lambda row: row.stream_id)
    if by_stream and sorted(stored.offsets, key=lambda row: row.stream_id) != by_stream:
        report.problems.append(f"{path.name} has other rows than {SESSION_NAME}")


def _check_warm_up(report: SessionReport, notes: Mapping[str, object]) -> None:
    """Verify the warm-up frames; the session is whole without them.

    Args:
        report: findings are added here.
        notes: notes of the session's frames, which have their hash.
    """
    try:
        read_warm_up(report.path / FRAMES_NAME, notes)
    except DamagedFileError as error:
        report.problems.append(
            f"{WARM_UP_NAME}: {error.what}; deleted, `foottile estimate` begins without history"
        )
    except FileFormatError as error:
        report.unproven.append(
            f"{WARM_UP_NAME} {error.what}: `foottile estimate` begins without history"
        )


def _check_derived_file(
    report: SessionReport, path: Path, read_frames_sha256: Callable[[Path], str]
) -> None:
    """Verify a file that is made again from the frames if it is missing.

    Args:
        report: findings are added here.
        path: the file.
        read_frames_sha256: reads the whole file; returns the hash of the frames it was made from.
    """
    try:
        frames_sha256 = read_frames_sha256(path)
    except FileNotFoundError:
        return
    except OtherVersionError as error:
        report.unproven.append(f"{path.name}: {error.what}; it is made again")
    except (FileFormatError, StorageError) as error:
        report.problems.append(f"{path.name}: {error.what}; deleted, it is made again")
    else:
        if frames_sha256 != report.sha256:
            report.unproven.append(f"{path.name}: it is of other frames, and nobody reads it")


def _read_overview_frames_sha256(path: Path) -> str:
    with open_overview(path) as overview:
        for level in range(overview.index.level_count):
            overview.read_bins(level, None, None)
        return overview.index.frames_sha256


def _read_sidecar(
    report: SessionReport, path: Path, read: Callable[[Path], _T], *, is_optional: bool
) -> _T | None:
    try:
        return read(path)
    except FileNotFoundError:
        if not is_optional:
            report.problems.append(f"{path.name} is missing")
        return None
    except (FileFormatError, StorageError) as error:
        report.problems.append(f"{path.name}: {error.what}")
        return None


def _count_ledger(
    report: SessionReport, data: Path, session: Session, streams: StreamVerifier
) -> None:
    """Count the ledger of an unsealed session from the journals."""
    if not (data / "journal").is_dir():
        report.unproven.append("which of its frames are stored: its journals are not here")
        return
    reports: dict[str, StreamReport] = {}
    for part in session.parts:
        folder = data / "journal" / session.node / part.stream_id
        if part.stream_id not in reports and folder.is_dir() and not folder.is_symlink():
            reports[part.stream_id] = found = streams(folder)
            report.problems += [
                f"journal {part.stream_id}: {problem}" for problem in found.problems
            ]
        reports.setdefault(part.stream_id, StreamReport(session.node, part.stream_id))
    # For a server's folder a node may still send frames; a node's own folder has all of them.
    may_come = Intervals([(0, NO_END)] if (data / "nodes").is_dir() else ())
    states = mark_damaged_and_abandoned_lost(
        session, {b: found.to_stream_state(may_come) for b, found in reports.items()}
    )
    ledger = compute_ledger(session.parts, states, has_all_parts=session.stopped_t_ns is not None)
    report.ledger = ledger.model_copy(update={"complete": False})
