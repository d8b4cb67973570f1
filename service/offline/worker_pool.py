"""Pool of workers: processes of this machine, or a Dask cluster with a task per worker thread.

Either yields results in order of completion and survives killed workers: the task goes to another
one, and fails after several losses, `MAX_LOSSES` or `distributed.scheduler.allowed-failures`. A
task may run twice without harm, because each job checks for an existing result first. No task is
queued on a worker, so the death of a worker is blamed on its running task only.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import platform
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from importlib.metadata import PackageNotFoundError, version
from multiprocessing.connection import Connection, wait
from typing import Any, Generic, TypeVar

from devices.errors import (
    LinkError,
    UsageError,
    WorkerLostError,
    escape_control_chars,
    require_extra,
)
from service.version import compute_exact_version

Task = TypeVar("Task")
Result = TypeVar("Result")
_NO_TASK: Any = object()


class Unfinished:
    """Result of a partly done task, which is then submitted again, to any free worker."""


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
    pool = _Pool(work, initializer)
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


_CONNECT_S = 15.0
_NUMERIC_PACKAGES = ("numpy", "numba", "pyarrow")
"""Packages whose version may change numeric results."""


def collect_versions() -> dict[str, str]:
    """Return the versions that a result depends on: foottile, Python and numeric packages."""
    found = {
        "foottile": compute_exact_version(),
        "python": ".".join(platform.python_version_tuple()[:2]),
    }
    for name in _NUMERIC_PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "none"
    return found


def map_on_cluster(
    work: Callable[[Task], Result | Unfinished], tasks: Iterable[Task], *, scheduler_address: str
) -> Iterator[tuple[Task, Result | Exception]]:
    """Run tasks on a Dask cluster; yield each with its result or its worker's exception.

    Args:
        work: a module-level function, which returns expected failures as results.
        tasks: arguments of `work`, consumed only as threads become free. A task that returns
            `Unfinished` is submitted again, to any worker.
        scheduler_address: the scheduler's, such as tcp://host:8786.

    Raises:
        MissingExtraError: Dask is not installed.
        LinkError: the scheduler does not answer, disconnects, or has no workers.
        UsageError: a worker runs another version.
    """
    with require_extra("archive", "--scheduler"):
        import distributed
    dask: Any = distributed  # its type stubs lack the functions used here
    for name in ("distributed", "distributed.client"):  # its errors are reported below
        logging.getLogger(name).setLevel(logging.CRITICAL)
    with _connect_to_cluster(dask, scheduler_address) as client:
        _check_worker_versions(client.run(collect_versions, on_error="return"))
        under_way: dict[str, Task] = {}
        done, left = dask.as_completed(loop=client.loop), iter(tasks)
        again = deque[Task]()
        while True:
            while len(under_way) < _count_threads(client, scheduler_address):
                task = again.popleft() if again else next(left, _NO_TASK)
                if task is _NO_TASK:
                    break
                future = client.submit(work, task, pure=False)
                under_way[future.key] = task
                done.add(future)
            if not under_way:
                return
            future = next(done)
            task = under_way.pop(future.key)
            if future.status not in ("finished", "error"):
                raise _make_unreachable_error(scheduler_address, f"a task is {future.status}")
            result: Result | Unfinished | Exception = (
                future.exception() if future.status == "error" else future.result()
            )
            if isinstance(result, dask.scheduler.KilledWorker):
                result = WorkerLostError("several workers were killed while running it")
            future.release()
            if isinstance(result, Unfinished):
                again.append(task)
            else:
                yield task, result


@contextmanager
def _connect_to_cluster(dask: Any, address: str) -> Iterator[Any]:
    """Context manager: connect to a scheduler that has a worker; yield the client."""
    with ExitStack() as stack:
        try:
            client = stack.enter_context(
                dask.Client(address, timeout=_CONNECT_S, set_as_default=False, name="foottile")
            )
            client.wait_for_workers(1, timeout=_CONNECT_S)
        except (OSError, ValueError) as error:
            raise _make_unreachable_error(address, error) from error
        yield client


def _count_threads(client: Any, address: str) -> int:
    """Return the thread count of all connected workers, at least 1: a worker may still join."""
    try:
        return max(1, sum(int(n) for n in client.nthreads().values()))
    except OSError as error:
        raise _make_unreachable_error(address, error) from error


def _make_unreachable_error(address: str, why: object) -> LinkError:
    return LinkError(
        f"no Dask cluster to work on: {escape_control_chars(' '.join(str(why).split()))[:200]}",
        where=address,
        remedy="Start scheduler and workers; the same command goes on where it was broken off",
    )


def _check_worker_versions(found: dict[str, Any]) -> None:
    """Reject workers whose versions differ from this client's.

    Raises:
        UsageError: a worker runs another version.
    """
    ours = collect_versions()
    for worker, theirs in found.items():
        if isinstance(theirs, OSError):
            continue  # disconnected; `run_job` checks the version again if it returns
        if theirs != ours:
            differ = (
                ", ".join(
                    f"{name} {theirs.get(name)} (here {ours[name]})"
                    for name in ours
                    if theirs.get(name) != ours[name]
                )
                if isinstance(theirs, dict)
                else f"version unknown: {theirs}"
            )
            raise UsageError(
                f"a worker is of another version: {escape_control_chars(differ)[:300]}",
                where=worker,
                remedy="Install the same foottile and packages for client and workers",
            )
