"""A job: one task applied to one session. It is idempotent.

The worker that runs a job checks for an existing result; the client keeps no list of results.
"""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import pyarrow as pa

from devices.errors import FootTileError, StateError, UsageError
from service.offline.archive.pieces import Pieces
from service.offline.archive.places import Place, check_text, is_remote
from service.offline.archive.results import Note, Results, files_in
from service.offline.archive.staging import identity, staged
from service.offline.archive.tasks import LongTask, Task
from service.offline.archive.workspace import SYSTEM, workspace
from service.offline.processes import GoesOn
from service.version import exact_software

log = logging.getLogger("foottile.archive")


@dataclass(frozen=True)
class Job:
    """Task applied to one session.

    Attributes:
        place: location of the session.
        task: the operation.
        out: results folder, as a path or URI; None: results are discarded.
        software: the client's version; a worker of another version refuses the job.
    """

    place: Place
    task: Task
    out: str | None
    software: str = field(default_factory=exact_software)


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


def begin_worker() -> None:
    """Limit Arrow to one thread: there is one worker process per core."""
    pa.set_cpu_count(1)


def run_job(job: Job) -> Outcome | GoesOn:
    """Run a job, or one chunk of it if the session is long; skip it if its result exists.

    Raises:
        UsageError: worker and client run different versions.
    """
    if job.software != exact_software():
        raise UsageError(
            f"a worker is {exact_software()}, and the client {job.software}",
            remedy="Install the same foottile for both: others may give other numbers",
        )
    name, where = job.place.name, job.place.where
    try:
        done = _done(job)
    except FootTileError as error:
        return failed(job, str(error))
    except Exception as error:  # one session must not stop the others
        log.exception("%s: this is a bug", where)
        return failed(job, f"this is a bug: {type(error).__name__}: {error}")
    return done if isinstance(done, GoesOn) else Outcome(name, where, *done)


def failed(job: Job, reason: str) -> Outcome:
    """Return the outcome of a failed job."""
    return Outcome(job.place.name, job.place.where, "failed", reason=reason)


def _done(job: Job) -> tuple[Literal["made", "there"], dict[str, Any]] | GoesOn:
    task, place = job.task, job.place
    check_text(place)
    if job.out is None:
        with staged(place) as source, workspace(SYSTEM) as work:
            return "made", task.run(source, work)
    _check_target(place, job.out)
    results = Results(job.out)
    asked = Note(
        command=task.command,
        software=job.software,
        place=place.where,
        input_sha256=identity(place),
        options=plain(task.options()),
        files={},
        facts={},
    )
    there = results.note(place.name, task.command)
    if there is not None:
        if there.is_of(asked):
            return "there", dict(there.facts)
        if there.place != place.where and there.input_sha256 != asked.input_sha256:
            raise StateError(
                f"another session of this name has its result there: {there.place}",
                where=place.where,
                remedy="Name another --out for it, or delete that result",
            )
    pieces = None
    with staged(place) as source:
        if isinstance(task, LongTask) and task.is_long(source):
            pieces = Pieces(job.out, place.name, asked.key)
            with pieces.folder(task.PIECES) as folder:
                if task.make_piece(source, folder):
                    return GoesOn()
            with pieces.folder() as folder:
                made = _made(results, place.name, task, partial(task.join, source, folder))
        else:
            made = _made(results, place.name, task, partial(task.run, source))
    facts, files = made
    results.keep(place.name, replace(asked, files=files, facts=facts))
    if pieces is not None:
        pieces.forget()
    return "made", facts


def _made(
    results: Results, name: str, task: Task, run: Callable[[Path], dict[str, Any]]
) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    with results.made(name, task.command) as work:
        return plain(run(work)), files_in(work)


def _check_target(place: Place, out: str) -> None:
    """Check that the result folder lies directly in `out` and is not the session's own folder.

    Raises:
        UsageError: it is the session's folder, or the name is not usable.
    """
    if place.name.startswith(".") or not place.name:
        raise UsageError(f"{place.name!r} cannot be the name of a result", where=place.where)
    target = f"{out.rstrip('/')}/{place.name}"
    is_same = target == place.where
    if not (is_remote(target) or is_remote(place.where)):
        is_same = os.path.realpath(target) == os.path.realpath(place.where)
    if is_same:
        raise UsageError(
            "its result would take the place of the session itself",
            where=place.where,
            remedy="Name another --out",
        )


def plain(value: Any) -> Any:
    """Return a value as a JSON round trip gives it back."""
    return json.loads(json.dumps(value))
