"""Commands over many sessions: messages, exit codes, and files after an interruption."""

from __future__ import annotations

import json
import os
import shutil
import signal
from contextlib import closing
from functools import partial
from pathlib import Path

import pytest

from tests.service.cli.outcome import Run
from tests.service.offline.archives import IDS, recording, sealed
from tests.service.process import Process
from tests.waiting import until

COPIES = 24
"""Enough that a client is stopped before it has finished."""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    data = tmp_path_factory.mktemp("many")
    sealed(data, 0, 20.0, 40.0)
    sealed(data, 1, 30.0)
    return data


@pytest.fixture
def data(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "data"))


def report(out: Path, command: str) -> list[dict[str, object]]:
    lines = (out / f"{command}.report.jsonl").read_text().splitlines()
    return [json.loads(line) for line in lines]


@pytest.mark.slow
def test_many_sessions_are_estimated_each_into_its_folder(
    run: Run, data: Path, tmp_path: Path
) -> None:
    done = run("estimate", data, "--out", "out", "--jobs", 2).succeeds()
    assert "2 made, 0 there before" in done.out
    assert {line["name"] for line in report(tmp_path / "out", "estimate")} == set(IDS[:2])
    again = run("estimate", data, "--out", "out", "--jobs", 1, "--json").succeeds()
    lines = [json.loads(line) for line in again.out.splitlines()]
    assert [line["state"] for line in lines] == ["there", "there"]
    proof = run("verify", "out", "data", "--jobs", 1).succeeds()
    assert "verify: 4 verified; 4 complete" in proof.out
    alone = run("verify", "out", "--jobs", 1).succeeds()
    assert "2 complete" in alone.out


def test_a_failed_session_is_listed_with_its_reason_and_exit_code_3(
    run: Run, data: Path, tmp_path: Path
) -> None:
    recording(data, 2)
    done = run("export", data, "--format", "csv", "--out", "out", "--jobs", 1)
    done.fails(3, f"{IDS[2]}: ", "it is recording, and not sealed yet")
    assert all(line.count(str(data)) <= 1 for line in done.err.splitlines())
    assert "2 made, 0 there before, 1 failed" in done.out
    states = {line["name"]: line["state"] for line in report(tmp_path / "out", "export")}
    assert states == {IDS[0]: "made", IDS[1]: "made", IDS[2]: "failed"}


def test_a_manifest_is_exported_and_its_missing_session_fails(
    run: Run, data: Path, tmp_path: Path
) -> None:
    text = f"session\ndata/sessions/{IDS[1]}\ndata/sessions/gone\n"
    (tmp_path / "list.csv").write_text(text)
    done = run("export", "--manifest", "list.csv", "--format", "csv", "--out", "out", "--jobs", 1)
    done.fails(3, "gone", "no such file")
    assert (tmp_path / "out" / IDS[1] / "frames.csv").is_file()


def test_a_damaged_session_among_many_gives_exit_code_1(run: Run, data: Path) -> None:
    (data / "sessions" / IDS[1] / "clock.parquet").unlink()
    done = run("verify", f"{data}/sessions/*", "--jobs", 1, "--out", "proofs")
    assert done.code == 1
    assert "2 verified, 0 there before; 1 complete, 1 damaged" in done.out
    assert f"{IDS[1]}: damaged: clock.parquet is missing" in done.err
    assert "pull a damaged session again" in done.out.lower()


@pytest.mark.slow(parts=8)
@pytest.mark.process
def test_an_interrupted_and_then_killed_client_goes_on_and_leaves_the_same_files(
    run: Run, made: Path, tmp_path: Path
) -> None:
    names = {f"trial{number}" for number in range(COPIES)}
    (tmp_path / "trials").mkdir()
    for name in names:
        source = made / "sessions" / IDS[0] / "frames.parquet"
        shutil.copy(source, tmp_path / "trials" / f"{name}.parquet")
    words = ("estimate", f"{tmp_path}/trials/*.parquet", "--models", "static", "--jobs")
    out = tmp_path / "out"
    kept: dict[Path, int] = {}

    def has_more_than(known: int) -> bool:
        return len([*out.glob("*/estimate.made.json")]) > known

    for number, code in ((signal.SIGINT, 130), (signal.SIGKILL, -signal.SIGKILL)):
        with closing(Process(*words, 2, "--out", out, folder=tmp_path / "run")) as client:
            until(partial(has_more_than, len(kept)))
            client.process.send_signal(number)
            assert client.ended() == code
        before = kept
        kept = {path: path.stat().st_mtime_ns for path in out.glob("*/estimate.made.json")}
        assert before.items() <= kept.items()
    run(*words, 1, "--out", out).succeeds()
    lines = report(out, "estimate")
    assert {line["name"] for line in lines} == names
    there = {line["name"] for line in lines if line["state"] == "there"}
    assert {path.parent.name for path in kept} <= there
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    assert run(*words, 1, "--out", "whole").code == 0
    resumed, whole = (
        {
            path.relative_to(folder): path.read_bytes()
            for path in folder.rglob("*")
            if path.is_file() and path.suffix != ".jsonl"
        }
        for folder in (out, tmp_path / "whole")
    )
    assert resumed == whole
    assert set(os.listdir(out)) == {*names, "estimate.report.jsonl"}


def test_the_path_of_a_failed_file_is_printed_once(run: Run, tmp_path: Path) -> None:
    (tmp_path / "bad").mkdir()
    for name in ("a", "b"):
        (tmp_path / "bad" / f"{name}.parquet").write_bytes(b"PAR1, and no more")
    done = run("estimate", "bad/*.parquet", "--out", "o", "--jobs", 1)
    done.fails(3, "bad/a.parquet: ")
    lines = [line for line in done.err.splitlines() if ".parquet" in line]
    assert [line.count(".parquet") for line in lines] == [1, 1]
