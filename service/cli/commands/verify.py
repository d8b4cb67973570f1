"""`foottile verify` and `foottile recover`: proofs of files, and repair after a crash."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from devices.errors import UsageError
from service.cli.multi_session import BatchOptions, is_single_session, run_task
from service.cli.options import (
    EXIT_INCOMPLETE,
    SESSION_REMEDY,
    JsonOption,
    add_options,
    echo,
    format_not_sampled,
    print_json,
    remark,
    resolve_data_folder,
    show_progress,
)

if TYPE_CHECKING:
    from service.sessions.recovery import RecoveredSession, RecoveryReport
    from storage.sessions.folder import Ledger
    from storage.verify.data_folder import Report, Verdict
    from storage.verify.journal import StreamReport
    from storage.verify.sealed_file import ExportReport
    from storage.verify.session import SessionReport


_EXIT_CODES = {"complete": 0, "lossy": 3, "pending": 3, "damaged": 1, "unproven": 4, "export": 4}
_VERDICT_TEXTS = {"unproven": "not all proven"}
_VERDICT_SENTENCES = {
    "complete": "Everything is whole, and every frame that was sampled is there.",
    "lossy": "Everything is whole, but some frames are lost for good: they are counted above.",
    "pending": "Everything is whole, but not every session is sealed yet.",
    "damaged": "Something is damaged: do not trust what is named above. Pull a damaged session "
    "again (`foottile pull ID --out FOLDER`), or restore it from a backup.",
    "unproven": "Nothing is damaged, but not all of it can be proven: it is named above.",
    "export": "An export: it proves nothing; the session that it was made from does.",
}


@add_options
def verify_command(
    targets: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="TARGET ...",
            help="Session (folder, or id in --data), data folder, one of their files, calibration; "
            "or many sessions: folders, globs, URIs.",
        ),
    ] = None,
    data: Annotated[
        Path | None,
        typer.Option(help="Data folder of the server or node; default: the user's."),
    ] = None,
    out: Annotated[
        str | None,
        typer.Option(help="Folder or URI for the reports of many sessions; existing ones stay."),
    ] = None,
    *,
    batch: BatchOptions,
    as_json: JsonOption = False,
) -> None:
    """Verify sessions and journals from their files: checksums, hashes, order and ledger.

    Nothing is written, and a server may run at the same time. Exit codes: 0 intact and complete, 1
    damaged, 2 wrong usage, 3 intact, but lossy or not yet sealed, 4 not fully verifiable, as a file
    outside its session, or an export: verify its source session. For many sessions: 1 if one is
    damaged, 3 also if one cannot be read.
    """
    from storage.verify.data_folder import find_verdict, verify_path

    if out is not None or _has_many_sessions(targets, batch.manifest):
        _verify_many(targets, batch, out, as_json=as_json)
        return
    path = _find_path((targets or [""])[0], data)
    with show_progress(f"reading {path}"):
        report = verify_path(path, data_folder=data)
    verdict = find_verdict(report)
    if as_json:
        print_json(report.to_json_dict())
    else:
        _print_report(report)
        echo(_VERDICT_SENTENCES[verdict])
    if code := _EXIT_CODES[verdict]:
        raise typer.Exit(code)


def _has_many_sessions(targets: list[str] | None, manifest: Path | None) -> bool:
    """Return whether the targets are many sessions; a data folder counts as one target."""
    if manifest is None and targets is not None and len(targets) == 1 and Path(targets[0]).exists():
        from service.offline.archive.locations import find_session_locations, is_data_folder

        if not Path(targets[0]).is_dir() or is_data_folder(targets[0]):
            return False
        return (
            not is_single_session(targets, None)
            and next(find_session_locations(targets), None) is not None
        )
    return not is_single_session(targets, manifest)


def _verify_many(
    targets: list[str] | None,
    batch: BatchOptions,
    out: str | None,
    *,
    as_json: bool,
) -> None:
    from service.offline.archive.tasks import VerifyTask

    summary = run_task(VerifyTask(), targets, batch, out=out, as_json=as_json)
    codes = {_EXIT_CODES[verdict] for verdict in summary.verdicts if _EXIT_CODES[verdict]}
    codes |= {EXIT_INCOMPLETE} if summary.states["failed"] else set()
    if summary.verdicts["damaged"] and not as_json:
        echo(_VERDICT_SENTENCES["damaged"])
    if codes:
        raise typer.Exit(min(codes))


def _find_path(target: str, data: Path | None) -> Path:
    path = Path(target)
    if path.exists():
        return path
    root = resolve_data_folder(data)
    for place in ("sessions", "trash"):
        if "/" not in target and (root / place / target).is_dir():
            return root / place / target
    raise UsageError(
        f"no session, file or folder {target!r}",
        where=str(root),
        expected="a path, or the id of a session in --data",
        remedy=SESSION_REMEDY,
    )


def _print_report(report: Report, *, is_part: bool = False) -> None:
    from storage.verify.data_folder import DataFolderReport
    from storage.verify.journal import SegmentReport
    from storage.verify.sealed_file import ExportReport
    from storage.verify.session import SessionReport

    remarks: list[str] = []
    unproven: list[str] = []
    if isinstance(report, DataFolderReport):
        parts: list[Report] = [*report.sessions, *report.streams]
        for part in parts:
            _print_report(part, is_part=True)
        unproven = report.to_json_dict()["unproven"]
        remarks = [f"{name}: set aside, it counts no more" for name in report.set_aside]
    elif isinstance(report, SessionReport):
        echo(_format_session(report))
        unproven = report.unproven
    elif isinstance(report, ExportReport):
        echo(_format_export(report))
    elif isinstance(report, SegmentReport):
        closed = "closed" if report.is_closed else "not closed"
        echo(f"segment {report.path.name}: {report.stored.number_count} frames, {closed}")
        remarks = report.remarks
    else:
        echo(_format_stream(report))
        remarks = report.remarks
    for problem in report.problems:
        echo(f"  damaged: {problem}")
    for text in remarks:
        echo(f"  {text}")
    for what in () if is_part else unproven:
        echo(f"  not proven: {what}")


def _format_session(report: SessionReport) -> str:
    from storage.verify.data_folder import find_verdict

    verdict: Verdict = find_verdict(report)
    text = (
        "in the trash"
        if report.is_in_trash and verdict != "damaged"
        else _VERDICT_TEXTS.get(verdict, verdict)
    )
    name = f" ({report.name})" if report.name else ""
    return f"session {report.id or report.path.name}{name}: {text}, {_format_ledger(report.ledger)}"


def _format_export(report: ExportReport) -> str:
    source = {name: value for name, value in report.source.items() if value not in (None, [])}
    text = ", ".join(f"{name} {value}" for name, value in source.items())
    return f"export {report.path.name} ({report.format}): {text or 'it does not say of what'}"


def _format_ledger(ledger: Ledger | None) -> str:
    if ledger is None:
        return "unknown frames"
    counts = {f"lost ({reason})": count for reason, count in ledger.lost.items()}
    counts["pending"] = ledger.pending
    text = f"{ledger.recorded} recorded"
    text += "".join(f", {count} {what}" for what, count in counts.items() if count)
    tail = ledger.max_lost_tail_frames
    text += f", and at most {tail} more when it broke off" if tail else ""
    if not ledger.missed_slots:
        return text
    return f"{text}{format_not_sampled(ledger.not_sampled_share)} ({ledger.missed_slots} slots)"


def _format_stream(report: StreamReport) -> str:
    lost = sum(numbers.number_count for numbers in report.lost.by_reason.values())
    return (
        f"journal {report.node}/{report.stream_id}: {report.stored.number_count} frames in "
        f"{report.segment_count} segments"
        + (f", {lost} lost" if lost else "")
        + (f", {report.absent_not_lost.number_count} not here" if report.absent_not_lost else "")
    )


_EXIT_FAILED = 1


def recover_command(
    folder: Annotated[Path, typer.Argument(help="Data folder of a server, or journal of a node.")],
    streams: Annotated[
        bool,
        typer.Option("--streams", help="Also make sessions of frames that belong to none."),
    ] = False,
    abandon_missing: Annotated[
        bool,
        typer.Option(
            "--abandon-missing",
            help="On a server: count the missing frames of nodes as lost.",
        ),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Repair journals and seal sessions after a crash, without a server.

    A server does this at its start; this command is for a folder without a server, and for a node.
    It can be repeated. Exit codes: 0 success, 1 something was not recovered, 2 wrong usage, 3 done,
    but a session is lossy or waits for its node.
    """
    from service.sessions.recovery import recover_locked_folder
    from storage.durable_files import lock_folder
    from storage.permissions import set_umask_and_create_private_folder

    if not any((folder / name).is_dir() for name in ("journal", "sessions")):
        raise UsageError(
            f"no data folder {str(folder)!r}",
            expected="a folder with `journal` and `sessions`, of a server or a node",
        )
    set_umask_and_create_private_folder(folder)
    with lock_folder(folder), show_progress("opening journals") as report_step:
        recovery = recover_locked_folder(
            folder, make_sessions=streams, abandon_missing=abandon_missing, report_step=report_step
        )
    if as_json:
        print_json(_make_recovery_json(recovery))
    else:
        _print_recovery(recovery)
    if recovery.problems or any(found.outcome == "failed" for found in recovery.sessions):
        raise typer.Exit(_EXIT_FAILED)
    if any(found.ledger is None or not found.ledger.complete for found in recovery.sessions):
        raise typer.Exit(EXIT_INCOMPLETE)


def _make_recovery_json(recovery: RecoveryReport) -> dict[str, Any]:
    return {
        "sessions": [
            {
                **(found.ledger.model_dump(mode="json") if found.ledger is not None else {}),
                "id": found.session.id,
                "name": found.session.name,
                "outcome": found.outcome,
                "problem": found.problem or None,
                "sha256": found.session.sha256,
            }
            for found in recovery.sessions
        ],
        "removed": [str(path) for path in recovery.removed_temporaries],
        "cut_bytes": recovery.cut_bytes,
        "mended": recovery.rewritten_markers,
        "restored": recovery.rebuilt_sessions,
        "problems": recovery.problems,
    }


def _print_recovery(recovery: RecoveryReport) -> None:
    for name, cut_bytes in recovery.cut_bytes.items():
        echo(f"journal {name}: {cut_bytes} bytes after the last complete batch were set aside")
    if recovery.removed_temporaries:
        echo(f"{len(recovery.removed_temporaries)} incomplete files were removed")
    for session_id in recovery.rewritten_markers:
        echo(f"session {session_id}: markers.parquet was written again")
    for session_id in recovery.rebuilt_sessions:
        echo(f"session {session_id}: session.json was rebuilt from the files beside it")
    for found in recovery.sessions:
        echo(f"session {found.session.id} ({found.session.name}): {_format_outcome(found)}")
        if found.problem:
            echo(f"  {found.problem}")
    for problem in recovery.problems:
        echo(f"not recovered: {problem}")
    if recovery.is_empty_or_all_waiting:
        echo("nothing to recover")
    if any(found.outcome == "waiting" for found in recovery.sessions):
        remark("the server completes the waiting sessions; --abandon-missing seals them now")


def _format_outcome(found: RecoveredSession) -> str:
    ledger = found.ledger
    if found.outcome != "sealed" or ledger is None:
        return {"waiting": "waits for its node"}.get(found.outcome, "NOT recovered")
    lost = sum(ledger.lost.values())
    text = f"sealed and verified, {ledger.recorded} frames" + (f", {lost} lost" if lost else "")
    tail = ledger.max_lost_tail_frames
    return text + (f", at most {tail} more at its end" if tail else "")
