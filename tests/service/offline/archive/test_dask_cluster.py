"""The same plan on a real Dask cluster of processes, one of which is killed on the way."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from devices.errors import LinkError, UsageError, WorkerLostError
from service.offline.archive.jobs import Job, run_job, run_jobs
from service.offline.archive.locations import find_session_locations
from service.offline.archive.result_store import ResultStore
from service.offline.worker_pool import Unfinished, map_on_cluster
from tests.service.offline.archive.clusters import Cluster
from tests.service.offline.archive.workers import (
    assert_each_task_comes_with_its_result,
    killed_at_two,
    squared,
)
from tests.service.offline.archives import IDS, STATIC, contents, long_session, made, ran
from tests.service.sessions.pieces import calibration

pytestmark = [pytest.mark.process, pytest.mark.slow, pytest.mark.in_turn]
COPIES = 10


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    with Cluster(tmp_path_factory.mktemp("cluster"), workers=2) as started:
        yield started


@pytest.fixture
def trials(archive: Path, tmp_path: Path) -> Path:
    (tmp_path / "trials").mkdir()
    for number in range(COPIES):
        source = archive / "sessions" / IDS[number % 4] / "frames.parquet"
        shutil.copy(source, tmp_path / "trials" / f"t{number}.parquet")
    return tmp_path / "trials"


def jobs(trials: Path, out: Path) -> Iterator[Job]:
    for place in find_session_locations([f"{trials}/*.parquet"]):
        yield Job(place, STATIC, str(out))


def test_a_worker_that_is_killed_costs_nothing_and_results_are_those_of_one_process(
    cluster: Cluster, trials: Path, tmp_path: Path
) -> None:
    out, states = tmp_path / "out", list[str]()
    cluster.add_worker()
    for outcome in run_jobs(
        jobs(trials, out), partial(map_on_cluster, scheduler_address=cluster.address)
    ):
        # One that the killed worker had finished but not told is found by the worker after it.
        assert outcome.state == "made" or (outcome.state == "there" and len(states) >= 3), outcome
        states.append(outcome.state)
        if len(states) == 3:
            cluster.workers[0].kill()
    assert len(states) == COPIES
    assert states.count("there") <= 1
    assert len(made(ran(STATIC, f"{trials}/*.parquet", tmp_path / "alone"))) == COPIES
    assert contents(out) == contents(tmp_path / "alone")
    ResultStore(str(out)).remove_work_folder()
    assert not (out / ".work").exists()


def test_a_long_session_goes_from_worker_to_worker_and_a_killed_one_costs_its_piece(
    cluster: Cluster, tmp_path: Path
) -> None:
    (tmp_path / "raw").mkdir()
    for number in range(2):
        long_session(tmp_path / "raw" / f"t{number}.parquet")
    task = replace(STATIC, calibration=calibration())
    places = list(find_session_locations([f"{tmp_path}/raw/*.parquet"]))
    pieces = [Job(p, replace(task, piece_frames=1), str(tmp_path / "out")) for p in places]
    for job in pieces:
        assert isinstance(run_job(job), Unfinished)  # begun here, gone on with there
    cluster.add_worker()
    states = list[str]()
    for outcome in run_jobs(pieces, partial(map_on_cluster, scheduler_address=cluster.address)):
        if not states:
            cluster.workers[-2].kill()
        states.append(outcome.state)
    assert states in (["made", "made"], ["made", "there"])  # it may have had no time to tell
    assert len(made(ran(task, f"{tmp_path}/raw/*.parquet", tmp_path / "alone"))) == 2
    assert contents(tmp_path / "out") == contents(tmp_path / "alone")
    assert list((tmp_path / "out" / ".pieces").iterdir()) == []


def test_each_task_comes_with_its_result(cluster: Cluster, tmp_path: Path) -> None:
    map_tasks = partial(map_on_cluster, scheduler_address=cluster.address)
    assert_each_task_comes_with_its_result(map_tasks, tmp_path, ahead=3)


def test_a_worker_of_another_version_is_refused(
    cluster: Cluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "service.offline.worker_pool.compute_exact_version",
        lambda: "foottile 9 (ffffffffffff)",
    )
    with pytest.raises(UsageError, match="another version: foottile foottile"):
        list(map_on_cluster(squared, range(3), scheduler_address=cluster.address))


def test_a_missing_scheduler_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.offline.worker_pool._CONNECT_S", 1.0)
    with pytest.raises(LinkError, match="no Dask cluster"):
        list(map_on_cluster(squared, range(3), scheduler_address="tcp://127.0.0.1:9"))


def test_a_task_that_kills_every_worker_is_given_up_alone_and_a_scheduler_that_goes_ends_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Cluster(tmp_path, workers=5) as own:
        found = dict(map_on_cluster(killed_at_two, range(5), scheduler_address=own.address))
        assert isinstance(found.pop(2), WorkerLostError)
        assert found == {n: n for n in (0, 1, 3, 4)}
        monkeypatch.setattr("service.offline.worker_pool._CONNECT_S", 1.0)
        results = map_on_cluster(squared, iter(range(10**9)), scheduler_address=own.address)
        next(results)
        own.end_scheduler()
        with pytest.raises(LinkError, match="goes on where it was broken off"):
            for _ in results:
                pass
