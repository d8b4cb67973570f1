"""Work spread over processes: what is killed is done again, and given up in the end."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from devices.errors import WorkerLostError
from service.offline.process_pool import map_in_processes
from tests.service.offline.archive.workers import (
    counted,
    killed_at_two,
    killed_once,
    raising,
    squared,
)

pytestmark = pytest.mark.process


def test_every_task_comes_with_its_result() -> None:
    assert dict(map_in_processes(squared, range(20), 3)) == {n: n * n for n in range(20)}


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_task_that_goes_on_is_given_again_until_it_has_ended(tmp_path: Path, jobs: int) -> None:
    tasks = [tmp_path / "2", tmp_path / "0", tmp_path / "3"]
    found = dict(map_in_processes(counted, tasks, jobs))
    assert found == {path: int(path.name) + 1 for path in tasks}


def test_no_more_tasks_are_taken_than_there_are_processes() -> None:
    taken: list[int] = []

    def tasks() -> Iterator[int]:
        for number in range(10):
            taken.append(number)
            yield number

    for given, _ in enumerate(map_in_processes(squared, tasks(), 2), start=1):
        assert len(taken) <= given + 2


def test_an_error_comes_with_its_task_and_the_others_go_on() -> None:
    found = dict(map_in_processes(raising, range(4), 2))
    assert {n: found[n] for n in (0, 1, 3)} == {0: 0, 1: 1, 3: 3}
    assert isinstance(found[2], ValueError)


def test_a_task_whose_process_was_killed_is_done_by_another(tmp_path: Path) -> None:
    markers = [tmp_path / "a", tmp_path / "b"]
    assert dict(map_in_processes(killed_once, markers, 2)) == {
        marker: marker.name for marker in markers
    }


def test_a_task_over_which_processes_die_again_and_again_is_given_up_alone() -> None:
    found = dict(map_in_processes(killed_at_two, range(6), 2))
    lost = found.pop(2)
    assert isinstance(lost, WorkerLostError)
    assert "SIGKILL" in str(lost)
    assert found == {n: n for n in range(6) if n != 2}


def test_who_asks_for_no_more_leaves_no_process_behind() -> None:
    import multiprocessing

    results = map_in_processes(squared, iter(range(10**9)), 2)
    next(results)
    results.close()  # type: ignore[attr-defined]  # a generator
    assert multiprocessing.active_children() == []
