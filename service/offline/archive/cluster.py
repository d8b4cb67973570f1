"""The same jobs on a Dask cluster: one under way for each thread of its workers, and no more.

None waits behind another one: if a worker dies of a task, no other is held to have killed it.

A worker that is killed is the scheduler's business: it gives the task to another one, and gives it
up when it has cost several (`distributed.scheduler.allowed-failures`). That a task may run twice
does no harm: its result is asked for first.
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
"""Of other versions they may give other numbers."""


def versions() -> dict[str, str]:
    """What a result depends on, besides its input and options."""
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
    """Every task with its result as it is finished, or with the error that its worker raised.

    Args:
        work: a function of a module, that raises nothing it expects.
        tasks: what to call it with; no more are taken than are under way. With one that goes on
            it is called again, by any worker.
        address: of the scheduler, as tcp://host:8786.

    Raises:
        MissingExtraError: Dask is not installed.
        LinkError: the scheduler does not answer, or is gone, or has no workers.
        UsageError: a worker is of another version.
    """
    with needs_extra("archive", "--scheduler"):
        import distributed
    dask: Any = distributed  # it has types, but not for what is called here
    for name in ("distributed", "distributed.client"):  # what matters of it is said by us
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
                    result = WorkerLostError("workers were killed over it, again and again")
            else:
                raise _away(address, f"a task is {future.status}")
            future.release()
            if isinstance(result, GoesOn):
                again.append(task)
            else:
                yield task, result


def _threads(client: Any, address: str) -> int:
    """Of all workers that are there now; one at least, for one may come."""
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
    """Refuse workers that may give other numbers than this client."""
    ours = versions()
    for worker, theirs in found.items():
        if isinstance(theirs, OSError):
            continue  # it is gone; one that comes back is asked by the job
        if theirs != ours:
            differ = (
                ", ".join(
                    f"{name} {theirs.get(name)} (here {ours[name]})"
                    for name in ours
                    if theirs.get(name) != ours[name]
                )
                if isinstance(theirs, dict)
                else f"it cannot say: {theirs}"
            )
            raise UsageError(
                f"a worker is of another version: {printable(differ)[:300]}",
                where=worker,
                remedy="Install the same foottile and packages for client and workers",
            )
