"""`foottile verify`: what files prove of themselves."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from devices.errors import UsageError
from service.cli.options import JsonOption, print_json, progress, remark, say

if TYPE_CHECKING:
    from storage.sessions.folder import Ledger
    from storage.verify.data import Report, Verdict
    from storage.verify.journal import StreamReport
    from storage.verify.segment import SegmentReport
    from storage.verify.session import SessionReport

_EXIT = {"complete": 0, "lossy": 3, "pending": 3, "damaged": 1}
_SENTENCE = {
    "complete": "Everything is whole and complete.",
    "lossy": "Everything is whole, but some frames are lost for good: they are counted above.",
    "pending": "Everything is whole, but not every session is sealed yet.",
    "damaged": "Something is damaged: do not trust what is named above.",
}


def verify_command(
    target: Annotated[
        str,
        typer.Argument(
            help="Session (folder, or id in --data), sealed file, journal, or data folder."
        ),
    ],
    data: Annotated[
        Path | None,
        typer.Option(help="Data folder of the server or node; default: the user's."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Prove sessions and journals from their files alone: checksums, hashes, order and ledger.

    Nothing is written, and a server may run beside it. Exit codes: 0 everything is whole and
    complete, 1 something is damaged, 2 wrong usage, 3 whole, but lossy or not yet sealed.
    """
    from storage.verify.data import as_dict, verdict_of, verify

    path = _path_of(target, data)
    with progress(f"reading {path}"):
        report = verify(path, data=data)
    verdict = verdict_of(report)
    if as_json:
        print_json(as_dict(report))
    else:
        _tell(report)
        say(_SENTENCE[verdict])
    if code := _EXIT[verdict]:
        raise typer.Exit(code)


def _path_of(target: str, data: Path | None) -> Path:
    from platformdirs import user_data_path

    path = Path(target)
    if path.exists():
        return path
    root = data if data is not None else user_data_path("foottile")
    for place in ("sessions", "trash"):
        if "/" not in target and (root / place / target).is_dir():
            return root / place / target
    raise UsageError(
        f"no session, file or folder {target!r}",
        where=str(root),
        expected="a path, or the id of a session in --data",
    )


def _tell(report: Report) -> None:
    from storage.verify.data import FolderReport
    from storage.verify.segment import SegmentReport
    from storage.verify.session import SessionReport

    if isinstance(report, FolderReport):
        for session in report.sessions:
            _tell_session(session)
        for stream in report.streams:
            _tell_stream(stream)
        for problem in report.problems:
            say(f"  damaged: {problem}")
    elif isinstance(report, SessionReport):
        _tell_session(report)
        for what in report.unproven:
            remark(f"not proven: {what}")
    elif isinstance(report, SegmentReport):
        _tell_segment(report)
    else:
        _tell_stream(report)


def _tell_session(report: SessionReport) -> None:
    from storage.verify.data import verdict_of

    verdict: Verdict = verdict_of(report)
    said = "in the trash" if report.in_trash and verdict != "damaged" else verdict
    name = f" ({report.name})" if report.name else ""
    say(f"session {report.id or report.path.name}{name}: {said}, {_counts(report.ledger)}")
    for problem in report.problems:
        say(f"  damaged: {problem}")


def _counts(ledger: Ledger | None) -> str:
    if ledger is None:
        return "nothing can be said of its frames"
    counts = {"recorded": sum(part.recorded for part in ledger.parts)}
    for part in ledger.parts:
        for reason, lost in part.lost.items():
            counts[f"lost ({reason})"] = counts.get(f"lost ({reason})", 0) + lost
    counts["pending"] = sum(part.pending for part in ledger.parts)
    text = ", ".join(f"{n} {what}" for what, n in counts.items() if n or what == "recorded")
    tail = sum(part.unsynced_tail_max for part in ledger.parts)
    text += f", and at most {tail} more when it broke off" if tail else ""
    return text + (f", {ledger.missed_slots} slots missed" if ledger.missed_slots else "")


def _tell_stream(report: StreamReport) -> None:
    lost = sum(numbers.count for numbers in report.lost.by_reason.values())
    say(
        f"journal {report.node}/{report.boot_id}: {report.held.count} frames in "
        f"{report.segments} segments"
        + (f", {lost} lost" if lost else "")
        + (f", {report.missing.count} not here" if report.missing else "")
    )
    for problem in report.problems:
        say(f"  damaged: {problem}")
    for text in report.remarks:
        say(f"  {text}")


def _tell_segment(report: SegmentReport) -> None:
    closed = "closed" if report.is_closed else "not closed"
    say(f"segment {report.path.name}: {report.held.count} frames, {closed}")
    for problem in report.problems:
        say(f"  damaged: {problem}")
    for text in report.remarks:
        say(f"  {text}")
