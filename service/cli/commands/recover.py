"""`foottile recover`: after a crash, journals to sessions."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from devices.errors import UsageError
from service.cli.options import JsonOption, print_json, progress, remark, say

if TYPE_CHECKING:
    from service.sessions.recovery import RecoveredSession, RecoveryReport

_FAILED, _NOT_ALL = 1, 3


def recover_command(
    folder: Annotated[Path, typer.Argument(help="Data folder of a server, or journal of a node.")],
    streams: Annotated[
        bool,
        typer.Option("--streams", help="Make sessions of frames that belong to none, too."),
    ] = False,
    give_up: Annotated[
        bool,
        typer.Option(
            "--give-up",
            help="On a server: count what nodes have not brought as lost, and do not wait.",
        ),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Repair journals and seal sessions after a crash, without a server.

    A server does this by itself when it is started; this is for a folder that has none, and for a
    node alone. It can be run again at any time. Exit codes: 0 good, 1 something could not be
    recovered, 2 wrong usage, 3 done, but a session is lossy, or waits for its node.
    """
    from service.sessions.recovery import recover_folder
    from storage.durable_files import lock_folder
    from storage.permissions import restrict_to_owner

    if not any((folder / name).is_dir() for name in ("journal", "sessions")):
        raise UsageError(
            f"no data folder {str(folder)!r}",
            expected="a folder with `journal` and `sessions`, of a server or a node",
        )
    restrict_to_owner(folder)
    with lock_folder(folder), progress("opening journals") as tell:
        recovery = recover_folder(
            folder, make_sessions=streams, abandon_missing=give_up, report_step=tell
        )
    if as_json:
        print_json(_as_dict(recovery))
    else:
        _tell(recovery)
    if recovery.problems or any(found.outcome == "failed" for found in recovery.sessions):
        raise typer.Exit(_FAILED)
    if any(found.ledger is None or not found.ledger.complete for found in recovery.sessions):
        raise typer.Exit(_NOT_ALL)


def _as_dict(recovery: RecoveryReport) -> dict[str, Any]:
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


def _tell(recovery: RecoveryReport) -> None:
    for name, cut_bytes in recovery.cut_bytes.items():
        say(f"journal {name}: {cut_bytes} bytes behind the last whole batch were set aside")
    if recovery.removed_temporaries:
        say(f"{len(recovery.removed_temporaries)} half-written files were removed")
    for session_id in recovery.rewritten_markers:
        say(f"session {session_id}: markers.parquet was written again")
    for session_id in recovery.rebuilt_sessions:
        say(f"session {session_id}: session.json was made again from the files beside it")
    for found in recovery.sessions:
        say(f"session {found.session.id} ({found.session.name}): {_outcome(found)}")
        if found.problem:
            say(f"  {found.problem}")
    for problem in recovery.problems:
        say(f"not recovered: {problem}")
    if recovery.is_empty:
        say("nothing to recover")
    if any(found.outcome == "waiting" for found in recovery.sessions):
        remark("what waits for its node is completed by the server, or sealed with --give-up")


def _outcome(found: RecoveredSession) -> str:
    ledger = found.ledger
    if found.outcome != "sealed" or ledger is None:
        return {"waiting": "waits for its node"}.get(found.outcome, "NOT recovered")
    lost = sum(ledger.lost.values())
    text = f"sealed and proven, {ledger.recorded} frames" + (f", {lost} lost" if lost else "")
    tail = ledger.max_lost_tail_frames
    return text + (f", at most {tail} more when it broke off" if tail else "")
