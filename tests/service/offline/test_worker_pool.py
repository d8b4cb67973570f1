"""Work spread over processes: what is killed is done again, and given up in the end."""

from __future__ import annotations

import multiprocessing
from functools import partial
from pathlib import Path

import pytest

from devices.errors import WorkerLostError
from service.offline.worker_pool import map_in_processes
from tests.service.offline.archive.workers import (
    assert_each_task_comes_with_its_result,
    counted,
    killed_at_two,
    killed_once,
    squared,
)

pytestmark = pytest.mark.process


def test_each_task_comes_with_its_result(tmp_path: Path) -> None:
    map_tasks = partial(map_in_processes, process_count=2)
    assert_each_task_comes_with_its_result(map_tasks, tmp_path, ahead=2)


def test_an_unfinished_task_is_given_again_in_this_process_as_well(tmp_path: Path) -> None:
    tasks = [tmp_path / "2", tmp_path / "0"]
    assert dict(map_in_processes(counted, tasks, 1)) == {tasks[0]: 3, tasks[1]: 1}


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


def test_a_caller_that_stops_early_leaves_no_process_behind() -> None:
    results = map_in_processes(squared, iter(range(10**9)), 2)
    next(results)
    results.close()  # type: ignore[attr-defined]  # a generator
    assert multiprocessing.active_children() == []
