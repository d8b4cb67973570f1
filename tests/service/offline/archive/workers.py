"""Tasks for workers, by names that another process imports, and the law of all that maps them."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from service.offline.worker_pool import Unfinished


def squared(number: int) -> int:
    return number * number


def raising(number: int) -> int:
    if number == 2:
        raise ValueError("two")
    return number


def counted(path: Path) -> int | Unfinished:
    """Goes on as often as its name says, then says how often it was called."""
    calls = 1 + (int(path.read_text()) if path.exists() else 0)
    path.write_text(str(calls))
    return calls if calls > int(path.name) else Unfinished()


def killed_once(marker: Path) -> str:
    """Killed the first time."""
    if not marker.exists():
        marker.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return marker.name


def killed_at_two(number: int) -> int:
    if number == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def assert_each_task_comes_with_its_result(map_tasks: Any, folder: Path, *, ahead: int) -> None:
    """With its error, too; an unfinished one is given again; few are taken before their turn."""
    tasks = [folder / "2", folder / "0", folder / "3"]
    assert dict(map_tasks(counted, tasks)) == {path: int(path.name) + 1 for path in tasks}
    found = dict(map_tasks(raising, range(4)))
    assert isinstance(found.pop(2), ValueError)
    assert found == {0: 0, 1: 1, 3: 3}
    taken: list[int] = []

    def numbers() -> Iterator[int]:
        for number in range(50):
            taken.append(number)
            yield number

    results = {}
    for given, (task, result) in enumerate(map_tasks(squared, numbers()), start=1):
        assert len(taken) <= given + ahead
        results[task] = result
    assert results == {n: n * n for n in range(50)}
