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

from devices.errors import (
    LinkError,
    UsageError,
    WorkerLostError,
    escape_control_chars,
    require_extra,
)
from service.offline.process_pool import Unfinished
from service.version import compute_exact_version

Task = TypeVar("Task")
Result = TypeVar("Result")
_NO_TASK: Any = object()
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
    with ExitStack() as stack:
        try:
            client = stack.enter_context(
                dask.Client(
                    scheduler_address, timeout=_CONNECT_S, set_as_default=False, name="foottile"
                )
            )
            client.wait_for_workers(1, timeout=_CONNECT_S)
        except (OSError, ValueError) as error:
            raise _make_unreachable_error(scheduler_address, error) from error
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
            result: Result | Unfinished | Exception
            if future.status == "finished":
                result = future.result()
            elif future.status == "error":
                result = future.exception()
                if isinstance(result, dask.scheduler.KilledWorker):
                    result = WorkerLostError("several workers were killed while running it")
            else:
                raise _make_unreachable_error(scheduler_address, f"a task is {future.status}")
            future.release()
            if isinstance(result, Unfinished):
                again.append(task)
            else:
                yield task, result


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
