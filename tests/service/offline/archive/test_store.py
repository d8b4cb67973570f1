"""An archive in an S3-compatible store: found, worked on, put back; also over a bad connection."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from itertools import count
from pathlib import Path

import pytest

from service.offline.archive import locations
from service.offline.archive.jobs import Job, run_job, run_jobs
from service.offline.archive.locations import find_session_locations
from service.offline.archive.query import find_sessions, run_query
from service.offline.archive.result_store import ResultStore
from service.offline.archive.tasks import VerifyTask
from service.offline.worker_pool import Unfinished, map_in_processes
from tests.service.offline.archive.stores import BUCKET, BadWay, Store
from tests.service.offline.archives import IDS, STATIC, long_session, made, ran
from tests.service.sessions.pieces import calibration

pytestmark = pytest.mark.slow
FOLDER, SESSIONS = f"s3://{BUCKET}/2026", f"s3://{BUCKET}/2026/sessions"


def way_to(endpoint: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """From now on the store is reached there."""
    monkeypatch.setenv("AWS_ENDPOINT_URL", endpoint)
    locations._make_s3_filesystem.cache_clear()


@pytest.fixture
def store(archive: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Store]:
    with Store(monkeypatch) as started:
        started.put(archive / "sessions", "2026/sessions")
        locations._make_s3_filesystem.cache_clear()
        yield started
    locations._make_s3_filesystem.cache_clear()


def test_sessions_of_a_store_are_worked_on_and_results_put_back(
    store: Store, archive: Path, tmp_path: Path
) -> None:
    out = f"s3://{BUCKET}/estimated"
    found = ran(STATIC, FOLDER, out)
    assert {name: each.state for name, each in found.items()} == dict.fromkeys(IDS[:4], "made")
    ran(STATIC, archive, tmp_path / "out")
    for name in IDS[:4]:
        there = store.content(f"estimated/{name}")
        here = {path.name: path.read_bytes() for path in (tmp_path / "out" / name).iterdir()}
        assert there.pop("estimate.made.json") != here.pop("estimate.made.json")  # their places
        assert there == here
    assert {each.state for each in ran(STATIC, FOLDER, out).values()} == {"there"}
    for place in (f"{out}/{IDS[2]}", f"{out}/{IDS[3]}/frames.parquet"):
        (one,) = ran(VerifyTask(), place, None).values()
        assert one.facts["verdict"] == "complete"


def test_pieces_of_a_long_session_are_in_the_store_until_it_is_there(
    store: Store, tmp_path: Path
) -> None:
    (tmp_path / "raw").mkdir()
    long = long_session(tmp_path / "raw" / "long.parquet")
    store.put(tmp_path / "raw", "long")
    task, out = replace(STATIC, calibration=calibration()), f"s3://{BUCKET}/estimated"
    (place,) = find_session_locations([f"s3://{BUCKET}/long/long.parquet"])
    job = Job(place, replace(task, piece_frames=1), out)
    assert isinstance(run_job(job), Unfinished)
    (found,) = run_jobs([job], partial(map_in_processes, process_count=1))
    assert found.state == "made", found.reason
    ran(task, long, tmp_path / "out")
    there = store.content("estimated/long")
    assert there["frames.parquet"] == (tmp_path / "out" / "long" / "frames.parquet").read_bytes()
    with pytest.raises(FileNotFoundError):
        store.content("estimated/.pieces/long")


@pytest.mark.parametrize("is_remote", [False, True])
def test_a_text_beside_the_results_is_written_wherever_they_are(
    store: Store, tmp_path: Path, is_remote: bool
) -> None:
    results = ResultStore(f"s3://{BUCKET}/out" if is_remote else str(tmp_path))
    with results.open_text("report.jsonl") as file:
        file.write("one\n")
    here = tmp_path / "report.jsonl"
    written = store.content("out")[here.name] if is_remote else here.read_bytes()
    assert written == b"one\n"


def test_a_result_in_a_store_of_which_an_object_is_gone_is_made_again(store: Store) -> None:
    out = f"s3://{BUCKET}/proofs"
    ran(VerifyTask(), SESSIONS, out)
    store.files.delete_file(f"{BUCKET}/proofs/{IDS[1]}/verify.json")
    assert made(ran(VerifyTask(), SESSIONS, out)) == {IDS[1]}


def test_a_store_that_refuses_and_breaks_off_costs_time_and_nothing_else(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    frames_read = count()

    def trouble(number: int, method: str, path: str) -> str:
        if number % 13 == 3:
            return "slow down"
        is_read = method == "GET" and path.endswith("frames.parquet")
        return "cut" if is_read and next(frames_read) % 3 == 0 else "pass"

    with BadWay(store, trouble) as way:
        way_to(way.endpoint, monkeypatch)
        assert made(ran(STATIC, FOLDER, f"s3://{BUCKET}/badly")) == set(IDS[:4])
        assert way.refused >= 3
        assert way.cut >= 1
    way_to(store.endpoint, monkeypatch)
    ran(STATIC, FOLDER, f"s3://{BUCKET}/well")
    assert store.content("badly") == store.content("well")


def test_a_session_that_a_store_will_not_give_fails_alone_and_the_next_run_makes_it(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = f"s3://{BUCKET}/proofs"
    closed: set[str] = set()
    monkeypatch.setattr(locations, "_S3_ATTEMPTS", 2)

    def trouble(number: int, method: str, path: str) -> str:
        return "slow down" if any(name in path for name in closed) else "pass"

    with BadWay(store, trouble) as way:
        way_to(way.endpoint, monkeypatch)
        closed.add(f"{IDS[1]}/frames.parquet")
        found = ran(VerifyTask(), FOLDER, out)
        assert {name for name, each in found.items() if each.state == "failed"} == {IDS[1]}
        assert "cannot be read" in found[IDS[1]].reason
        closed.clear()
        found = ran(VerifyTask(), FOLDER, out)
        assert {name: each.state for name, each in found.items()} == {
            **dict.fromkeys(IDS[:4], "there"),
            IDS[1]: "made",
        }


def test_questions_to_a_store_read_only_their_files_and_are_answered_as_for_folders(
    store: Store, archive: Path, tmp_path: Path
) -> None:
    store.files.delete_file(f"{BUCKET}/2026/sessions/{IDS[1]}/stances.parquet")
    store.files.delete_file(f"{BUCKET}/2026/sessions/{IDS[2]}/frames.parquet")
    shutil.rmtree(archive / "sessions" / IDS[2])
    for number, sql in enumerate(
        (
            "SELECT session_id, scene, frames FROM sessions ORDER BY 1",
            "SELECT session_id, number, peak_grf_n FROM stances ORDER BY ALL",
            "SELECT session_id, label FROM markers ORDER BY ALL",
            "SELECT session_id, sum(grf_n) AS n FROM frames GROUP BY 1 ORDER BY 1",
        )
    ):
        (mirror := tmp_path / f"mirror{number}").mkdir()
        found = find_sessions([f"s3://{BUCKET}/2026"], mirror)
        assert list(found.left_out_reasons.values()) == ["damaged: frames.parquet is missing"]
        assert run_query(found, sql).equals(run_query(find_sessions([str(archive)]), sql)), sql
        copied = list(mirror.rglob("frames.parquet"))
        assert len(copied) == (1 if "stances" in sql else 0)  # of the one without its own
    both = find_sessions([f"s3://{BUCKET}/2026", str(archive)], tmp_path / "mirror0")
    assert len(both.sessions) == 3
    mixed = [f"s3://{BUCKET}/2026/sessions/{IDS[0]}", f"{archive}/sessions/{IDS[3]}"]
    of_two = run_query(
        find_sessions(mixed, tmp_path / "mirror1"), "SELECT count(*) AS n FROM frames"
    )
    assert of_two.to_pylist() == [{"n": 800}]
