"""`foottile recover`: repair of journals and sessions after a crash."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from devices.errors import UsageError
from service.cli.options import JsonOption, echo, print_json, remark, show_progress

if TYPE_CHECKING:
    from service.sessions.recovery import RecoveredSession, RecoveryReport

_EXIT_FAILED, _EXIT_INCOMPLETE = 1, 3


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
        print_json(_to_json(recovery))
    else:
        _print_report(recovery)
    if recovery.problems or any(found.outcome == "failed" for found in recovery.sessions):
        raise typer.Exit(_EXIT_FAILED)
    if any(found.ledger is None or not found.ledger.complete for found in recovery.sessions):
        raise typer.Exit(_EXIT_INCOMPLETE)


def _to_json(recovery: RecoveryReport) -> dict[str, Any]:
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


def _print_report(recovery: RecoveryReport) -> None:
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
