"""Commands over many sessions: selection, parallel execution, report and summary."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import chain, count
from pathlib import Path
from typing import IO, TYPE_CHECKING, Annotated, Any

import typer

from devices.errors import UsageError, escape_control_chars
from service.cli.options import echo, remark, show_progress_bar, stderr

if TYPE_CHECKING:
    from service.offline.archive.jobs import Job, JobMapper, Outcome, OutcomeCounts
    from service.offline.archive.locations import SessionLocation
    from service.offline.archive.tasks import SessionTask


@dataclass(frozen=True)
class BatchOptions:
    """Options of a command over many sessions, which is decorated by `add_options`."""

    manifest: Annotated[
        Path | None,
        typer.Option(
            help="CSV with a row for each session, in column session; see docs/archive.md."
        ),
    ] = None
    jobs: Annotated[
        int | None, typer.Option(min=1, max=1024, help="Processes; default: one for each core.")
    ] = None
    scheduler: Annotated[
        str | None, typer.Option(help="Address of a Dask scheduler: run on its cluster.")
    ] = None

    def make_job_mapper(self) -> JobMapper:
        """Return a mapper to processes of this machine or to a cluster.

        Raises:
            UsageError: both are named.
        """
        if self.jobs is not None and self.scheduler is not None:
            raise UsageError("--jobs and --scheduler exclude each other", remedy="Name one")
        if self.scheduler is not None:
            from service.offline.worker_pool import map_on_cluster

            return partial(map_on_cluster, scheduler_address=self.scheduler)
        from service.offline.archive.jobs import limit_arrow_threads
        from service.offline.worker_pool import count_available_cores, map_in_processes

        return partial(
            map_in_processes,
            process_count=self.jobs or count_available_cores(),
            initializer=limit_arrow_threads,
        )


def is_single_session(places: Sequence[str] | None, manifest: Path | None) -> bool:
    """Return whether the arguments name a single session: a file, a folder or an id."""
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


def run_task(
    task: SessionTask,
    places: Sequence[str] | None,
    batch: BatchOptions,
    *,
    out: str | None,
    as_json: bool,
) -> OutcomeCounts:
    """Run a task on many sessions, print the failures and return the counts.

    An existing result of the same input and task is kept.

    Raises:
        UsageError: no sessions, two ways to name them, or a missing location.
    """
    from service.offline.archive.jobs import Job
    from service.offline.archive.locations import (
        find_session_locations,
        make_absolute,
        make_no_session_error,
        parse_session_location,
    )
    from service.offline.archive.manifest import read_rows

    manifest, job_mapper = batch.manifest, batch.make_job_mapper()
    if (manifest is None) == (not places):
        raise UsageError(
            "no session is named"
            if manifest is None
            else "--manifest and sessions exclude each other",
            expected="sessions, folders of them, or --manifest",
        )
    out = None if out is None else make_absolute(out)

    def list_locations() -> Iterator[SessionLocation]:
        if manifest is not None:
            return (
                parse_session_location(row["session"]) for row in read_rows(manifest, {"session"})
            )
        sessions = find_session_locations(places or ())
        first = next(sessions, None)
        if first is None:
            raise make_no_session_error(places or ())
        return chain([first], sessions)

    return run_jobs_with_report(
        (Job(place, task, out) for place in list_locations()),
        command=task.command,
        list_again=list_locations,
        out=out,
        job_mapper=job_mapper,
        as_json=as_json,
    )


def run_jobs_with_report(
    jobs: Iterable[Job],
    *,
    command: str,
    list_again: Callable[[], Iterator[Any]],
    out: str | None,
    job_mapper: JobMapper,
    as_json: bool,
) -> OutcomeCounts:
    """Run jobs, show progress, write the report and print a summary.

    Args:
        jobs: one for each session.
        command: name of the command.
        list_again: lists the sessions once more, to count them for a progress bar.
        out: path or URI of the results; None: no results.
        job_mapper: maps jobs to processes or a cluster.
        as_json: print each outcome as a line of JSON on stdout.

    Raises:
        UsageError: no job.
    """
    from service.offline.archive.jobs import OutcomeCounts, run_jobs
    from service.offline.archive.result_store import ResultStore

    jobs = iter(jobs)
    first = next(jobs, None)
    if first is None:
        raise UsageError("the list of sessions has no row")
    counts = OutcomeCounts()
    results = None if out is None else ResultStore(out)
    if results is not None:
        results.prepare_folder()
    with ExitStack() as stack:
        report: IO[str] | None = None
        if results is not None:
            report = stack.enter_context(results.open_text(f"{command}.report.jsonl"))
        show_outcome = stack.enter_context(_show_progress(command, list_again))
        for outcome in run_jobs(chain([first], jobs), job_mapper):
            counts.add_outcome(outcome)
            line = json.dumps({k: v for k, v in vars(outcome).items() if v not in ("", {})})
            if report is not None:
                report.write(line + "\n")
                report.flush()
            if as_json:
                echo(line)
            else:
                for problem in outcome.facts.get("problems", ()):
                    remark(f"{outcome.place}: damaged: {problem}")
            show_outcome(outcome)
    if results is not None:
        results.remove_work_folder()
    _print_summary(counts, command, out, as_json=as_json)
    return counts


@contextmanager
def _show_progress(
    command: str, list_again: Callable[[], Iterator[Any]]
) -> Iterator[Callable[..., None]]:
    """Show progress and remaining time on a terminal."""
    if not stderr.is_terminal:
        yield lambda outcome: None
        return
    done = count(1)
    with show_progress_bar(command, sum(1 for _ in list_again())) as show_done:

        def show_outcome(outcome: Outcome) -> None:
            if outcome.state == "failed":
                remark(_format_failure(outcome))
            show_done(next(done))

        yield show_outcome


def _format_failure(outcome: Outcome) -> str:
    """Return place and reason; the reason may already begin with a file in that place."""
    place = escape_control_chars(outcome.place)
    within = outcome.reason.startswith((f"{place}/", f"{place}: "))
    return outcome.reason if within else f"{place}: {outcome.reason}"


def _print_summary(counts: OutcomeCounts, command: str, out: str | None, *, as_json: bool) -> None:
    states = counts.states
    if not as_json:
        where = f"{out}: " if out is not None else ""
        parts = [f"{states['made']} {'verified' if command == 'verify' else 'made'}"]
        if out is not None:  # else nothing is kept
            parts.append(f"{states['there']} there before")
        verdicts = ", ".join(f"{n} {verdict}" for verdict, n in sorted(counts.verdicts.items()))
        failed = f", {states['failed']} failed" if states["failed"] else ""
        echo(f"{where}{command}: {', '.join(parts)}{failed}{'; ' if verdicts else ''}{verdicts}")
    for outcome in () if stderr.is_terminal else counts.failures:
        remark(_format_failure(outcome))
    if states["failed"] > len(counts.failures):
        remark(f"and {states['failed'] - len(counts.failures)} more, listed in the report")
