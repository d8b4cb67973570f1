"""Commands over many sessions: which are meant, how the work is spread, and what is said of it."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from itertools import chain
from pathlib import Path
from typing import IO, TYPE_CHECKING, Annotated, Any

import typer

from devices.errors import UsageError
from devices.text import escape_control_chars
from service.cli.options import remark, say, stderr

if TYPE_CHECKING:
    from service.offline.archive.job_runner import JobMapper, OutcomeCounts
    from service.offline.archive.jobs import Job, Outcome
    from service.offline.archive.locations import SessionLocation
    from service.offline.archive.tasks import SessionTask

NOT_ALL = 3
"""Exit code: finished, but not with every session."""

ManifestOption = Annotated[
    Path | None,
    typer.Option(help="CSV with a row for each session, in column session; see docs/archive.md."),
]
JobsOption = Annotated[
    int | None, typer.Option(min=1, max=1024, help="Processes; default: one for each core.")
]
SchedulerOption = Annotated[
    str | None,
    typer.Option(help="Work on a Dask cluster, at its scheduler's address, not on this machine."),
]


def is_one(places: Sequence[str] | None, manifest: Path | None) -> bool:
    """Is a single session asked for, as a file, a folder or an id?"""
    from service.offline.archive.locations import is_remote
    from storage.sessions.folder import FRAMES_NAME
    from storage.sessions.metadata import SESSION_NAME

    if manifest is not None or len(places or ()) != 1:
        return False
    (place,) = places or ()
    if is_remote(place) or not os.path.exists(place):
        return not is_remote(place) and not any(c in place for c in "*?[")
    names = (SESSION_NAME, FRAMES_NAME)
    return not os.path.isdir(place) or any(os.path.exists(f"{place}/{n}") for n in names)


def run_many(
    task: SessionTask,
    places: Sequence[str] | None,
    manifest: Path | None,
    *,
    out: str | None,
    jobs: int | None,
    scheduler: str | None,
    as_json: bool,
) -> OutcomeCounts:
    """Do a task with many sessions, say what became of each that failed, and count.

    A result that is there, made from the same in the same way, is not made again.

    Raises:
        UsageError: nothing, or twice the same, says which sessions; or a place is not there.
    """
    from service.offline.archive.jobs import Job
    from service.offline.archive.locations import (
        find_session_locations,
        make_absolute,
        make_no_session_error,
        parse_session_location,
    )
    from service.offline.archive.manifest import read_rows

    if (manifest is None) == (not places):
        raise UsageError(
            "no session is named" if manifest is None else "--manifest and sessions are two ways",
            expected="sessions, folders of them, or --manifest",
        )
    if jobs is not None and scheduler is not None:
        raise UsageError("--jobs and --scheduler are two ways to spread work", remedy="Name one")

    out = None if out is None else make_absolute(out)

    def found() -> Iterator[SessionLocation]:
        if manifest is not None:
            return (
                parse_session_location(row["session"]) for row in read_rows(manifest, {"session"})
            )
        sessions = find_session_locations(places or ())
        first = next(sessions, None)
        if first is None:
            raise make_no_session_error(places or ())
        return chain([first], sessions)

    return run_plan(
        (Job(place, task, out) for place in found()),
        command=task.command,
        count=found,
        out=out,
        spread=spread_over(jobs, scheduler),
        as_json=as_json,
    )


def run_plan(
    jobs: Iterable[Job],
    *,
    command: str,
    count: Callable[[], Iterator[Any]],
    out: str | None,
    spread: JobMapper,
    as_json: bool,
) -> OutcomeCounts:
    """Run jobs, show how far they are, write the report, and say what came of them.

    Args:
        jobs: one for each session.
        command: of their tasks.
        count: finds them once more, to count them where progress is shown.
        out: of their results; None: nothing is kept.
        spread: over processes or a cluster.
        as_json: each outcome is a line of JSON on stdout.
    """
    from service.offline.archive.job_runner import OutcomeCounts, run_jobs
    from service.offline.archive.result_store import ResultStore

    jobs = iter(jobs)
    first = next(jobs, None)
    if first is None:
        raise UsageError("there is no row in the list of sessions")
    summary = OutcomeCounts()
    results = None if out is None else ResultStore(out)
    if results is not None:
        results.prepare_folder()
    with ExitStack() as stack:
        report = stack.enter_context(_report(results, command))
        tell = stack.enter_context(_progress(command, count))
        for outcome in run_jobs(chain([first], jobs), spread):
            summary.add_outcome(outcome)
            line = json.dumps({k: v for k, v in vars(outcome).items() if v not in ("", {})})
            if report is not None:
                report.write(line + "\n")
                report.flush()
            if as_json:
                say(line)
            tell(outcome)
    if results is not None:
        results.remove_work_folder()
    _tell(summary, command, out, as_json=as_json)
    return summary


def spread_over(jobs: int | None, scheduler: str | None) -> JobMapper:
    """Processes of this machine, or a cluster."""
    if scheduler is not None:
        from service.offline.archive.dask_cluster import map_on_cluster

        return partial(map_on_cluster, scheduler_address=scheduler)
    from service.offline.archive.jobs import limit_arrow_threads
    from service.offline.process_pool import count_available_cores, map_in_processes

    return partial(
        map_in_processes,
        process_count=jobs or count_available_cores(),
        initializer=limit_arrow_threads,
    )


@contextmanager
def _report(results: Any, command: str) -> Iterator[IO[str] | None]:
    """A line for each outcome, beside the results; a store gets it when all is over."""
    if results is None:
        yield None
        return
    name = f"{command}.report.jsonl"
    if not results.is_remote:
        with open(f"{results.out}/{name}", "w", encoding="utf-8") as file:
            yield file
        return
    with tempfile.NamedTemporaryFile("w", encoding="utf-8", suffix=".jsonl") as file:
        try:
            yield file
        finally:
            file.flush()
            results.put_file(name, Path(file.name))


@contextmanager
def _progress(command: str, count: Callable[[], Iterator[Any]]) -> Iterator[Callable[..., None]]:
    """How far it is and how long it will take, on a terminal."""
    if not stderr.is_terminal:
        yield lambda outcome: None
        return
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    text = TextColumn("{task.description}")
    bar = Progress(text, BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), console=stderr)
    with bar:
        shown = bar.add_task(command, total=sum(1 for _ in count()))

        def tell(outcome: Outcome) -> None:
            if outcome.state == "failed":
                remark(_failure(outcome))
            bar.advance(shown)

        yield tell


def _failure(outcome: Outcome) -> str:
    """Place and reason; a reason may begin with a file in that place."""
    place = escape_control_chars(outcome.place)
    within = outcome.reason.startswith((f"{place}/", f"{place}: "))
    return outcome.reason if within else f"{place}: {outcome.reason}"


def _tell(summary: OutcomeCounts, command: str, out: str | None, *, as_json: bool) -> None:
    states = summary.states
    if not as_json:
        where = f"{out}: " if out is not None else ""
        counts = [f"{states['made']} made", f"{states['there']} there before"]
        verdicts = ", ".join(f"{n} {verdict}" for verdict, n in sorted(summary.verdicts.items()))
        failed = f", {states['failed']} failed" if states["failed"] else ""
        say(f"{where}{command}: {', '.join(counts)}{failed}{'; ' if verdicts else ''}{verdicts}")
    for outcome in () if stderr.is_terminal else summary.failures:
        remark(_failure(outcome))
    if states["failed"] > len(summary.failures):
        remark(f"and {states['failed'] - len(summary.failures)} more, which the report lists")
