"""One job: a task and one session. It is a function of these, and may be done twice.

Whether it was done before is asked where it runs: of what is there nothing is kept in memory.
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
    """A task for one session.

    Attributes:
        place: of the session.
        task: what to do.
        out: where results are put, as a path or URI; None: nothing is kept.
        software: of the client; a worker of another one refuses.
    """

    place: Place
    task: Task
    out: str | None
    software: str = field(default_factory=exact_software)


@dataclass(frozen=True)
class Outcome:
    """What became of a job.

    Attributes:
        name: of the session, and of its result's folder.
        place: of the session.
        state: made now, there already, or failed.
        facts: what there is to say of it; of one that failed nothing.
        reason: why it failed.
    """

    name: str
    place: str
    state: Literal["made", "there", "failed"]
    facts: dict[str, Any] = field(default_factory=dict)
    reason: str = ""


def begin_worker() -> None:
    """In a process of its own: there are as many as cores, so none needs threads for Arrow."""
    pa.set_cpu_count(1)


def run_job(job: Job) -> Outcome | GoesOn:
    """Do a job, unless its result is there; of a long session one piece.

    Raises:
        UsageError: this worker is of another version than the client.
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
    except Exception as error:  # one session may not hold up all others
        log.exception("%s: this is a bug", where)
        return failed(job, f"this is a bug: {type(error).__name__}: {error}")
    return done if isinstance(done, GoesOn) else Outcome(name, where, *done)


def failed(job: Job, reason: str) -> Outcome:
    """A job of which nothing came."""
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
    """A result has a folder of its own, in `out` and nowhere else.

    Raises:
        UsageError: it would be the session's, or its name is none.
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
    """As JSON gives it back."""
    return json.loads(json.dumps(value))
