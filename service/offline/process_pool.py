"""Process pool that yields results in order of completion and survives killed processes.

If a process is killed, as by a machine that runs out of memory, its task goes to another process;
after `MAX_LOSSES` losses the task fails.
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


class Unfinished:
    """Result of a partly done task, which is then submitted again, to any free process."""


MAX_LOSSES = 3
"""Number of killed processes after which a task fails."""
_TERMINATION_TIMEOUT_S = 5.0
"""Time to wait for a terminated process."""


def count_available_cores() -> int:
    """Count the cores that this process may use."""
    return len(os.sched_getaffinity(0))


def map_in_processes(
    work: Callable[[Task], Result | Unfinished],
    tasks: Iterable[Task],
    process_count: int,
    *,
    initializer: Callable[[], None] | None = None,
) -> Iterator[tuple[Task, Result | Exception]]:
    """Run tasks in processes; yield each with its result, or its process's exception, when done.

    `tasks` is consumed only as processes become free.

    Args:
        work: a module-level function, which returns expected failures as results.
        tasks: arguments of `work`; a task that returns `Unfinished` is submitted again.
        process_count: number of processes; 1: run in this process.
        initializer: a module-level function, called first in every process.
    """
    if process_count == 1:
        for task in tasks:
            while isinstance(result := work(task), Unfinished):
                pass
            yield task, result
        return
    pool = _Pool(work, process_count, initializer)
    left, again = iter(tasks), deque[tuple[Task, int]]()
    under_way: dict[Any, tuple[_Worker, Task, int]] = {}
    try:
        while True:
            while len(under_way) < process_count:
                task, losses = again.popleft() if again else (next(left, _NO_TASK), 0)
                if task is _NO_TASK:
                    break
                worker = pool.send_task(task)
                under_way[worker.connection] = worker, task, losses
            if not under_way:
                break
            for connection in wait(list(under_way)):
                worker, task, losses = under_way.pop(connection)
                try:
                    result = worker.connection.recv()
                except (EOFError, OSError):
                    code = worker.stop()
                    if losses + 1 < MAX_LOSSES:
                        again.append((task, losses + 1))
                    else:
                        yield task, _make_lost_error(losses + 1, code)
                    continue
                pool.idle.append(worker)
                if isinstance(result, Unfinished):
                    again.append((task, 0))
                else:
                    yield task, result
    finally:
        pool.stop(worker for worker, _, _ in under_way.values())


_NO_TASK: Any = object()


def _make_lost_error(times: int, code: int | None) -> WorkerLostError:
    with suppress(ValueError):
        name = signal.Signals(-(code or 0)).name
        return WorkerLostError(
            f"{times} processes were killed while running it, the last by {name}",
            remedy="If memory ran out, use fewer --jobs",
        )
    return WorkerLostError(f"{times} processes exited while running it, the last with {code}")


class _Worker:
    """Process that runs one task after the other."""

    def __init__(self, work: Callable[[Any], Any], begin: Callable[[], None] | None) -> None:
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        self._process = context.Process(target=_run_worker, args=(theirs, work, begin))
        with _defer_interrupts():
            self._process.start()
        theirs.close()

    def stop(self, *, at_once: bool = False) -> int | None:
        """Stop the process, and return its exit code."""
        self.connection.close()
        if at_once:
            self._process.terminate()
        self._process.join(_TERMINATION_TIMEOUT_S)
        if self._process.exitcode is None:
            self._process.kill()
            self._process.join()
        code = self._process.exitcode
        self._process.close()
        return code


class _Pool(Generic[Task, Result]):
    def __init__(
        self,
        work: Callable[[Task], Result | Unfinished],
        jobs: int,
        begin: Callable[[], None] | None,
    ) -> None:
        self.idle: list[_Worker] = []
        self._work, self._begin = work, begin

    def send_task(self, task: Task) -> _Worker:
        """Send a task to an idle process, or to a new one."""
        while self.idle:
            worker = self.idle.pop()
            with suppress(OSError):  # killed while idle
                worker.connection.send(task)
                return worker
            worker.stop()
        worker = _Worker(self._work, self._begin)
        with suppress(OSError):  # killed already: reading its result will fail
            worker.connection.send(task)
        return worker

    def stop(self, busy: Iterable[_Worker]) -> None:
        """Terminate busy processes and stop idle ones."""
        for worker in busy:
            worker.stop(at_once=True)
        for worker in self.idle:
            worker.stop()


def _run_worker(
    connection: Connection, work: Callable[[Any], Any], begin: Callable[[], None] | None
) -> None:
    """Run a process's loop until the client closes the connection or terminates it."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # runs cleanup code of open files
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
        with suppress(OSError):  # the client was killed: the next recv() ends the loop
            connection.send(result)


@contextmanager
def _defer_interrupts() -> Iterator[None]:
    """Start processes with Ctrl-C blocked: the client stops them.

    A Ctrl-C within the block is raised at its end, so that no process is half-started.
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
