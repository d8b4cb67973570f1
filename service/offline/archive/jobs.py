"""Jobs: one idempotent task applied to one session, and their run over many sessions.

The worker that runs a job checks for an existing result; the client keeps no list of results.

Only running jobs are in memory, however many sessions there are. The caller passes the function
that maps jobs over processes or a cluster; both yield each job with its outcome.
"""

from __future__ import annotations

import json
import logging
import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import pyarrow as pa

from devices.errors import FootTileError, StateError, UsageError, WorkerLostError
from service.offline.archive.local_copies import (
    SYSTEM_TEMP_FOLDER,
    create_workspace,
    hash_session,
    open_local_session,
)
from service.offline.archive.locations import SessionLocation, check_utf8, is_remote
from service.offline.archive.result_store import ChunkStore, ResultNote, ResultStore, hash_files
from service.offline.archive.tasks import ChunkedTask, SessionTask
from service.offline.worker_pool import Unfinished
from service.version import compute_exact_version

log = logging.getLogger("foottile.archive")


@dataclass(frozen=True)
class Job:
    """Task applied to one session.

    Attributes:
        location: location of the session.
        task: the operation.
        results_location: results folder, as a path or URI; None: results are discarded.
        client_version: the client's version; a worker of another version refuses the job.
    """

    location: SessionLocation
    task: SessionTask
    results_location: str | None
    client_version: str = field(default_factory=compute_exact_version)


@dataclass(frozen=True)
class Outcome:
    """Outcome of a job.

    Attributes:
        name: session id, and name of its result folder.
        place: location of the session.
        state: made now, present already ("there"), or failed.
        facts: the task's report; empty after a failure.
        reason: cause of the failure.
    """

    name: str
    place: str
    state: Literal["made", "there", "failed"]
    facts: dict[str, Any] = field(default_factory=dict)
    reason: str = ""


def limit_arrow_threads() -> None:
    """Limit Arrow to one thread: there is one worker process per core."""
    pa.set_cpu_count(1)


def run_job(job: Job) -> Outcome | Unfinished:
    """Run a job, or one chunk if the session is long; skip a job whose result exists.

    Raises:
        UsageError: worker and client run different versions.
    """
    if job.client_version != compute_exact_version():
        raise UsageError(
            f"a worker is {compute_exact_version()}, and the client {job.client_version}",
            remedy="Install the same foottile for both: others may give other numbers",
        )
    name, where = job.location.session_id, job.location.uri
    try:
        done = _run_unless_done(job)
    except FootTileError as error:
        return _make_failed_outcome(job, str(error))
    except Exception as error:  # one session must not stop the others
        log.exception("%s: this is a bug", where)
        return _make_failed_outcome(job, f"this is a bug: {type(error).__name__}: {error}")
    return done if isinstance(done, Unfinished) else Outcome(name, where, *done)


def _make_failed_outcome(job: Job, reason: str) -> Outcome:
    """Return the outcome of a failed job."""
    return Outcome(job.location.session_id, job.location.uri, "failed", reason=reason)


def _run_unless_done(job: Job) -> tuple[Literal["made", "there"], dict[str, Any]] | Unfinished:
    task, place = job.task, job.location
    check_utf8(place)
    if job.results_location is None:
        with open_local_session(place) as source, create_workspace(SYSTEM_TEMP_FOLDER) as work:
            return "made", task.process_session(source, work)
    _check_result_folder(place, job.results_location)
    results = ResultStore(job.results_location)
    requested = ResultNote(
        command=task.command,
        software=job.client_version,
        place=place.uri,
        input_sha256=hash_session(place),
        options=normalize_json(task.describe_options()),
        files={},
        facts={},
    )
    there = results.read_complete_note(place.session_id, task.command)
    if there is not None:
        if there.has_same_inputs(requested):
            return "there", dict(there.facts)
        if there.place != place.uri and there.input_sha256 != requested.input_sha256:
            raise StateError(
                f"another session of this name has its result there: {there.place}",
                where=place.uri,
                remedy="Name another --out for it, or delete that result",
            )
    pieces = None
    with open_local_session(place) as source:
        if isinstance(task, ChunkedTask) and task.needs_chunks(source):
            pieces = ChunkStore(job.results_location, place.session_id, requested.input_key)
            with pieces.open_folder(task.CHUNK_SUFFIXES) as folder:
                if task.process_next_chunk(source, folder):
                    return Unfinished()
            with pieces.open_folder() as folder:
                made = _make_result(
                    results, place.session_id, task, partial(task.join_chunks, source, folder)
                )
        else:
            made = _make_result(
                results, place.session_id, task, partial(task.process_session, source)
            )
    facts, files = made
    results.write_note(place.session_id, replace(requested, files=files, facts=facts))
    if pieces is not None:
        pieces.delete()
    return "made", facts


def _make_result(
    results: ResultStore, name: str, task: SessionTask, run: Callable[[Path], dict[str, Any]]
) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    with results.open_result_folder(name, task.command) as work:
        return normalize_json(run(work)), hash_files(work)


def _check_result_folder(place: SessionLocation, out: str) -> None:
    """Check that the result folder lies directly in `out` and is not the session's own folder.

    Raises:
        UsageError: it is the session's folder, or the name is not usable.
    """
    if place.session_id.startswith(".") or not place.session_id:
        raise UsageError(f"{place.session_id!r} cannot be the name of a result", where=place.uri)
    target = f"{out.rstrip('/')}/{place.session_id}"
    is_same = target == place.uri
    if not (is_remote(target) or is_remote(place.uri)):
        is_same = os.path.realpath(target) == os.path.realpath(place.uri)
    if is_same:
        raise UsageError(
            "its result would take the place of the session itself",
            where=place.uri,
            remedy="Name another --out",
        )


def normalize_json(value: Any) -> Any:
    """Return a value as a JSON round trip gives it back."""
    return json.loads(json.dumps(value))


JobMapper = Callable[
    [Callable[[Job], Outcome | Unfinished], Iterable[Job]],
    Iterator[tuple[Job, Outcome | Exception]],
]
MAX_LISTED_FAILURES = 20
"""Number of failures kept for display; the report has all."""


@dataclass
class OutcomeCounts:
    """Counts over the outcomes of a batch of jobs.

    Attributes:
        states: number of jobs by state: made, there, failed.
        verdicts: number of each verdict, for tasks with a verdict.
        failures: the first `MAX_LISTED_FAILURES` failures.
    """

    states: Counter[str] = field(default_factory=Counter)
    verdicts: Counter[str] = field(default_factory=Counter)
    failures: list[Outcome] = field(default_factory=list)

    def add_outcome(self, outcome: Outcome) -> None:
        """Count an outcome."""
        self.states[outcome.state] += 1
        if verdict := outcome.facts.get("verdict"):
            self.verdicts[verdict] += 1
        if outcome.state == "failed" and len(self.failures) < MAX_LISTED_FAILURES:
            self.failures.append(outcome)


def run_jobs(jobs: Iterable[Job], map_jobs: JobMapper) -> Iterator[Outcome]:
    """Run every job and yield its outcome, in order of completion.

    Raises:
        FootTileError: no job can run: workers have another version, or are not reachable.
    """
    for job, outcome in map_jobs(run_job, jobs):
        if isinstance(outcome, WorkerLostError):
            yield _make_failed_outcome(job, str(outcome))
        elif isinstance(outcome, Exception):
            raise outcome
        else:
            yield outcome
