"""Execution of jobs on a Dask cluster, with at most one task per worker thread.

No task is queued on a worker, so the death of a worker is blamed on its running task only.

The scheduler handles killed workers: it moves the task to another worker, and fails it after
several losses (`distributed.scheduler.allowed-failures`). A task may run twice without harm,
because each job checks for an existing result first.
"""

from __future__ import annotations

import logging
import platform
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from importlib.metadata import PackageNotFoundError, version
from typing import Any, TypeVar

from devices.errors import LinkError, UsageError, WorkerLostError, needs_extra
from devices.words import printable
from service.offline.processes import GoesOn
from service.version import exact_software

Task = TypeVar("Task")
Result = TypeVar("Result")
_NONE: Any = object()
_CONNECT_S = 15.0
_NUMBERS = ("numpy", "numba", "pyarrow")
"""Packages whose version may change numeric results."""


def versions() -> dict[str, str]:
    """Return the versions that a result depends on: foottile, Python and numeric packages."""
    found = {"foottile": exact_software(), "python": ".".join(platform.python_version_tuple()[:2])}
    for name in _NUMBERS:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "none"
    return found


def spread_over_cluster(
    work: Callable[[Task], Result | GoesOn], tasks: Iterable[Task], *, address: str
) -> Iterator[tuple[Task, Result | Exception]]:
    """Run tasks on a Dask cluster; yield each with its result or its worker's exception.

    Args:
        work: a module-level function, which returns expected failures as results.
        tasks: arguments of `work`, consumed only as threads become free. A task that returns
            `GoesOn` is submitted again, to any worker.
        address: the scheduler's, such as tcp://host:8786.

    Raises:
        MissingExtraError: Dask is not installed.
        LinkError: the scheduler does not answer, disconnects, or has no workers.
        UsageError: a worker runs another version.
    """
    with needs_extra("archive", "--scheduler"):
        import distributed
    dask: Any = distributed  # its type stubs lack the functions used here
    for name in ("distributed", "distributed.client"):  # its errors are reported below
        logging.getLogger(name).setLevel(logging.CRITICAL)
    with ExitStack() as stack:
        try:
            client = stack.enter_context(
                dask.Client(address, timeout=_CONNECT_S, set_as_default=False, name="foottile")
            )
            client.wait_for_workers(1, timeout=_CONNECT_S)
        except (OSError, ValueError) as error:
            raise _away(address, error) from error
        _check(client.run(versions, on_error="return"))
        under_way: dict[str, Task] = {}
        done, left = dask.as_completed(loop=client.loop), iter(tasks)
        again = deque[Task]()
        while True:
            while len(under_way) < _threads(client, address):
                task = again.popleft() if again else next(left, _NONE)
                if task is _NONE:
                    break
                future = client.submit(work, task, pure=False)
                under_way[future.key] = task
                done.add(future)
            if not under_way:
                return
            future = next(done)
            task = under_way.pop(future.key)
            result: Result | GoesOn | Exception
            if future.status == "finished":
                result = future.result()
            elif future.status == "error":
                result = future.exception()
                if isinstance(result, dask.scheduler.KilledWorker):
                    result = WorkerLostError("several workers were killed while running it")
            else:
                raise _away(address, f"a task is {future.status}")
            future.release()
            if isinstance(result, GoesOn):
                again.append(task)
            else:
                yield task, result


def _threads(client: Any, address: str) -> int:
    """Return the thread count of all connected workers, at least 1: a worker may still join."""
    try:
        return max(1, sum(int(n) for n in client.nthreads().values()))
    except OSError as error:
        raise _away(address, error) from error


def _away(address: str, why: object) -> LinkError:
    return LinkError(
        f"no Dask cluster to work on: {printable(' '.join(str(why).split()))[:200]}",
        where=address,
        remedy="Start scheduler and workers; the same command goes on where it was broken off",
    )


def _check(found: dict[str, Any]) -> None:
    """Reject workers whose versions differ from this client's.

    Raises:
        UsageError: a worker runs another version.
    """
    ours = versions()
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
                f"a worker is of another version: {printable(differ)[:300]}",
                where=worker,
                remedy="Install the same foottile and packages for client and workers",
            )
