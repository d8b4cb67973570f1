"""Work in processes of its own: each result as it is there, and an end when we are told to end.

A process may be killed, as by a machine that runs out of memory: its task goes to another one, and
is given up when it has cost several.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection, wait
from typing import Any, Generic, TypeVar

from devices.errors import WorkerLostError

Task = TypeVar("Task")
Result = TypeVar("Result")


class GoesOn:
    """Result of a task that is done in part: it is given again, to whoever is free."""


LOSSES_MAX = 3
"""A task that so many processes have died over is given up."""
_PATIENCE_S = 5.0
"""For a process that was told to end."""


def cores() -> int:
    """How many this process may use."""
    return len(os.sched_getaffinity(0))


def spread(
    work: Callable[[Task], Result | GoesOn],
    tasks: Iterable[Task],
    jobs: int,
    *,
    begin: Callable[[], None] | None = None,
) -> Iterator[tuple[Task, Result | Exception]]:
    """Every task with its result as it is finished, or with the error that its process raised.

    Tasks are taken as there is a process for them.

    Args:
        work: a function of a module, that raises nothing it expects.
        tasks: what to call it with; with one that goes on again and again.
        jobs: so many processes at the same time; 1: in this one.
        begin: a function of a module, called in every process first.
    """
    if jobs == 1:
        for task in tasks:
            while isinstance(result := work(task), GoesOn):
                pass
            yield task, result
        return
    pool = _Pool(work, jobs, begin)
    left, again = iter(tasks), deque[tuple[Task, int]]()
    under_way: dict[Any, tuple[_Worker, Task, int]] = {}
    try:
        while True:
            while len(under_way) < jobs:
                task, losses = again.popleft() if again else (next(left, _NONE), 0)
                if task is _NONE:
                    break
                worker = pool.give(task)
                under_way[worker.connection] = worker, task, losses
            if not under_way:
                break
            for connection in wait(list(under_way)):
                worker, task, losses = under_way.pop(connection)
                try:
                    result = worker.connection.recv()
                except (EOFError, OSError):
                    code = worker.end()
                    if losses + 1 < LOSSES_MAX:
                        again.append((task, losses + 1))
                    else:
                        yield task, _lost(losses + 1, code)
                    continue
                pool.idle.append(worker)
                if isinstance(result, GoesOn):
                    again.append((task, 0))
                else:
                    yield task, result
    finally:
        pool.end(worker for worker, _, _ in under_way.values())


_NONE: Any = object()


def _lost(times: int, code: int | None) -> WorkerLostError:
    with suppress(ValueError):
        name = signal.Signals(-(code or 0)).name
        return WorkerLostError(
            f"{times} processes were killed over it, the last by {name}",
            remedy="If memory ran out, use fewer --jobs",
        )
    return WorkerLostError(f"{times} processes ended over it, the last with {code}")


class _Worker:
    """A process that does one task after the other."""

    def __init__(self, work: Callable[[Any], Any], begin: Callable[[], None] | None) -> None:
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, work, begin))
        with _interrupts_wait():
            self._process.start()
        theirs.close()

    def end(self, *, at_once: bool = False) -> int | None:
        """Have it end; its exit code."""
        self.connection.close()
        if at_once:
            self._process.terminate()
        self._process.join(_PATIENCE_S)
        if self._process.exitcode is None:
            self._process.kill()
            self._process.join()
        code = self._process.exitcode
        self._process.close()
        return code


class _Pool(Generic[Task, Result]):
    def __init__(
        self, work: Callable[[Task], Result | GoesOn], jobs: int, begin: Callable[[], None] | None
    ) -> None:
        self.idle: list[_Worker] = []
        self._work, self._begin = work, begin

    def give(self, task: Task) -> _Worker:
        """Hand a task to a process that has none, or to a new one."""
        while self.idle:
            worker = self.idle.pop()
            with suppress(OSError):  # it was killed while it had nothing to do
                worker.connection.send(task)
                return worker
            worker.end()
        worker = _Worker(self._work, self._begin)
        with suppress(OSError):  # killed already: that is seen when its answer is read
            worker.connection.send(task)
        return worker

    def end(self, busy: Iterable[_Worker]) -> None:
        """Nobody waits for what is left: those who are busy are told to end."""
        for worker in busy:
            worker.end(at_once=True)
        for worker in self.idle:
            worker.end()


def _serve(
    connection: Connection, work: Callable[[Any], Any], begin: Callable[[], None] | None
) -> None:
    """Body of a process; it ends when its client has, or tells it to."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # what is open is cleaned up
    if begin is not None:
        begin()
    while True:
        try:
            task = connection.recv()
        except (EOFError, OSError):
            return
        try:
            result = work(task)
        except Exception as error:
            result = error
        with suppress(OSError):  # the client was killed; seen at the next task
            connection.send(result)


@contextmanager
def _interrupts_wait() -> Iterator[None]:
    """Processes that are started meanwhile know no Ctrl-C: we tell them when to end.

    One that comes meanwhile is not lost, and finds no process half-started.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    handler = signal.signal(signal.SIGINT, lambda number, _: came.append(number))
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # processes inherit it
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        signal.signal(signal.SIGINT, handler)
    if came:
        raise KeyboardInterrupt
