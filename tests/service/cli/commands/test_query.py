"""`foottile query`: answers as tables, JSON, CSV and Parquet, and its exit codes."""

from __future__ import annotations

from pathlib import Path

import pyarrow.parquet as pq
import pytest

from tests.service.cli.outcome import Run
from tests.service.offline.archives import IDS, recording, sealed

PEAKS = "SELECT number, peak_grf_n, is_whole FROM stances ORDER BY number"
MARKS = "SELECT label FROM markers"


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    data = tmp_path_factory.mktemp("archive")
    sealed(data, 0, 20.0, 40.0)
    return data


def test_an_answer_is_a_table_json_csv_or_parquet(run: Run, data: Path, tmp_path: Path) -> None:
    rows = run("query", PEAKS, data, "--json").printed()["rows"]
    assert [row["number"] for row in rows] == [1, 2]
    told = run("query", PEAKS, data).succeeds()
    head, *lines = told.out.splitlines()
    assert head.split() == ["number", "peak_grf_n", "is_whole"]
    assert [line.split()[0] for line in lines] == ["1", "2"]
    assert run("query", PEAKS, data, "--out", "answer.parquet").code == 0
    assert pq.read_table(tmp_path / "answer.parquet").to_pylist() == rows
    assert run("query", PEAKS, "--data", data, "--json").printed()["rows"] == rows


def test_numbers_are_numbers_in_json_and_dates_are_texts(run: Run, data: Path) -> None:
    sql = (
        "SELECT 1.5 AS part, 4 * (2::HUGEINT ** 62)::HUGEINT AS great, [1, NULL] AS list, "
        "{'a': 2.5} AS record, DATE '2020-01-01' AS day"
    )
    (row,) = run("query", sql, data, "--json").printed()["rows"]
    expected = {"part": 1.5, "great": 2**64, "list": [1, None], "record": {"a": 2.5}}
    assert row == {**expected, "day": "2020-01-01"}


def test_no_text_of_a_csv_is_a_formula(run: Run, data: Path) -> None:
    done = run("query", MARKS, data, "--csv").succeeds()
    assert done.out.splitlines() == ['"label"', '"\'=off"']


def test_omitted_sessions_are_named_with_exit_code_3(run: Run, tmp_path: Path) -> None:
    sealed(tmp_path, 0, 20.0)
    recording(tmp_path, 1)
    done = run("query", "SELECT count(*) AS n FROM sessions", tmp_path)
    done.fails(3, IDS[1], "left out: it is recording")
    assert done.out.split() == ["n", "1"]
    answer = run("query", "SELECT count(*) AS n FROM sessions", tmp_path, "--json").printed(3)
    assert answer["rows"] == [{"n": 1}]
    assert list(answer["left_out"]) == [str(tmp_path / "sessions" / IDS[1])]


def test_a_data_folder_without_a_session_yet_answers_with_nothing(run: Run, tmp_path: Path) -> None:
    (tmp_path / "data" / "sessions").mkdir(parents=True)
    answer = run("query", "SELECT count(*) AS n FROM sessions", "data", "--json").printed()
    assert answer["rows"] == [{"n": 0}]


ODD_VALUES = [
    "DATE '20000-01-01'",
    "TIMESTAMP '290000-01-01'",
    "'infinity'::DATE",
    "INTERVAL 100000000 YEARS",
    "170141183460469231731687303715884105727::HUGEINT",
    "[DATE '20000-01-01']",
    "{'a': INTERVAL 1 MONTH}",
]


@pytest.mark.parametrize("value", ODD_VALUES)
def test_a_value_that_python_or_a_format_has_not_is_text_or_a_sentence(
    run: Run, tmp_path: Path, value: str
) -> None:
    (tmp_path / "sessions").mkdir()
    for how in ((), ("--csv",), ("--json",), ("--out", "x.parquet")):
        outcome = run("query", f"SELECT {value} AS x", "--data", ".", *how)
        if outcome.code:
            outcome.fails(2, "'", "VARCHAR")
            assert outcome.err.count("\n") == 1
        else:
            assert "x" in outcome.out
