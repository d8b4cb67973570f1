"""A run that was broken off goes on; results of other code, or of other arrays, do not count."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from studies.broad import arrays as run
from studies.broad.arrays import ArrayTask, BroadOptions, run_array, run_broad_benchmark
from studies.broad.results import (
    get_result_path,
    hash_project_code,
    read_result,
    write_result,
)
from tests.studies.broad.kept import made, result


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Numbers of the arrays that were run, none of which takes its time."""
    numbers: list[int] = []

    def quickly(task: ArrayTask) -> object:
        numbers.append(task.number)
        return made(task)

    monkeypatch.setattr(run, "run_array", quickly)
    return numbers


@pytest.fixture
def options(tmp_path: Path) -> BroadOptions:
    return BroadOptions(arrays=3, seeds="development", process_count=1, folder=tmp_path)


def test_what_it_will_cost_is_said_after_the_first_array(
    asked: list[int], options: BroadOptions
) -> None:
    said: list[str] = []
    bench = run_broad_benchmark(options, said.append)
    assert asked == [0, 1, 2]
    assert [r.number for r in bench.results] == [0, 1, 2]
    assert said[0] == "1 of 3 arrays"
    assert said[1].startswith("2 arrays of about 30 s CPU each, 1 at a time: about 1 min")
    assert said[-1] == "3 of 3 arrays"


def test_a_run_that_was_broken_off_goes_on_and_says_the_cost_at_once(
    asked: list[int], options: BroadOptions
) -> None:
    run_broad_benchmark(replace(options, arrays=2), lambda _: None)
    said: list[str] = []
    bench = run_broad_benchmark(replace(options, arrays=4), said.append)
    assert asked == [0, 1, 2, 3]
    assert len(bench.results) == 4
    assert said[0] == "2 of 4 arrays are there already"
    assert "2 arrays of about 30 s" in said[1]


def test_an_array_that_was_written_in_part_is_run_again(
    asked: list[int], options: BroadOptions
) -> None:
    run_broad_benchmark(options, lambda _: None)
    path = get_result_path(options.folder, "development", 1)
    path.write_bytes(path.read_bytes()[:-40])
    run_broad_benchmark(options, lambda _: None)
    assert asked == [0, 1, 2, 1]


def test_arrays_of_other_code_or_other_seeds_or_another_repeatability_do_not_count(
    asked: list[int], options: BroadOptions, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = replace(options, arrays=1)
    run_broad_benchmark(one, lambda _: None)
    run_broad_benchmark(replace(one, seeds="judgement"), lambda _: None)
    run_broad_benchmark(replace(one, repeatability=0.03), lambda _: None)
    assert asked == [0, 0, 0]
    run_broad_benchmark(replace(one, repeatability=0.03), lambda _: None)
    assert asked == [0, 0, 0]
    monkeypatch.setattr(run, "hash_project_code", lambda: "another code")
    run_broad_benchmark(replace(one, repeatability=0.03), lambda _: None)
    assert asked == [0, 0, 0, 0]


def test_a_result_that_was_kept_is_the_same_result(tmp_path: Path) -> None:
    (tmp_path / "arrays").mkdir()
    write_result(tmp_path, result(7))
    assert read_result(get_result_path(tmp_path, "development", 7)) == result(7)
    assert read_result(get_result_path(tmp_path, "development", 8)) is None


def test_the_code_has_an_id_that_stays() -> None:
    assert hash_project_code() == hash_project_code()
    assert len(hash_project_code()) == 16


def test_seeds_of_development_and_of_judgement_never_meet() -> None:
    last = ArrayTask(99_999, "development", "").seed
    assert last < ArrayTask(0, "judgement", "").seed


def test_an_array_whose_bench_fails_is_refused_with_the_reason(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from devices.errors import CalibrationError
    from studies.broad import arrays

    def refuses(*_: object, **__: object) -> object:
        raise CalibrationError("it drifts", where="/some/folder/bench-T01.parquet")

    monkeypatch.setattr(arrays, "find_calibration", refuses)
    found = run_array(ArrayTask(0, "development", "this code"))
    assert found.judged == {}
    assert found.tiles_refused == 4
    assert [refusal.what for refusal in found.refusals] == [
        f"calibration of T0{i}" for i in range(1, 5)
    ]
    assert found.refusals[0].why == "bench-T01.parquet: it drifts"
    assert 0.0 <= found.repeatability <= 0.03
