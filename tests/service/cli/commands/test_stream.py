"""`foottile stream`: live frames as lines, which end quietly."""

from __future__ import annotations

import csv
import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.service.cli.outcome import Run
from tests.service.fake_node import FakeNode, Play
from tests.service.process import Start
from tests.service.running import Running
from tests.waiting import PATIENCE_S, until


def test_each_frame_in_order_is_a_line_of_csv_or_json(
    running: Running, tared: FakeNode, run: Run
) -> None:
    asked = ("stream", "bench", "--columns", "grf_n", "--frames", 40, "--server", running.url)
    with Play(tared, 20.0):
        as_csv, as_json = run(*asked), run(*asked, "--format", "jsonl")
    assert (as_csv.code, as_json.code, as_csv.err, as_json.err) == (0, 0, "", "")
    head, *table = csv.reader(as_csv.out.splitlines())
    rows = [json.loads(line) for line in as_json.out.splitlines()]
    assert all([*row] == head == ["seq", "t_ns", "grf_n", "recomputed"] for row in rows)
    for seqs in ([int(row[0]) for row in table], [row["seq"] for row in rows]):
        assert seqs == list(range(seqs[0], seqs[0] + 40))


@pytest.mark.slow
def test_ctrl_c_ends_a_stream_without_a_message(
    running: Running, tared: FakeNode, foottile: Start
) -> None:
    with Play(tared):
        process = foottile("stream", "--server", running.url)
        until(lambda: len(process.out) > 2)
        process.process.send_signal(signal.SIGINT)
        assert process.ended() == 0
    assert not process.err


@pytest.mark.slow
def test_a_stream_without_a_reader_ends_without_a_message(
    running: Running, tared: FakeNode, tmp_path: Path
) -> None:
    command = str(Path(sys.executable).parent / "foottile")
    with (
        Play(tared),
        subprocess.Popen(
            [command, "stream", "bench", "--server", running.url],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            cwd=tmp_path,
        ) as process,
    ):
        assert process.stdout is not None
        assert process.stderr is not None
        assert process.stdout.readline().startswith(b'"seq"')
        process.stdout.close()
        assert process.wait(PATIENCE_S) == 0
        assert process.stderr.read() == b""


def test_a_wrong_request_ends_with_one_line_and_a_code(
    running: Running, tared: FakeNode, run: Run
) -> None:
    for arguments, line in (
        (("ankle",), "no node 'ankle'"),
        (("bench", "--columns", "grf_n_sigma"), "did you mean 'grf_sigma_n'?"),
        (("bench", "--format", "xml"), "expected csv or jsonl"),
    ):
        outcome = run("stream", "--server", running.url, *arguments)
        assert (outcome.code, line in outcome.err) == (2, True), (arguments, outcome.err)
        assert len(outcome.err.splitlines()) == 1, (arguments, outcome.err)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sink", "code", "reason"), [("> /dev/full", 1, "No space left on device"), (">&-", 0, "")]
)
def test_a_full_disk_is_an_error_and_a_closed_output_is_none(
    running: Running, tared: FakeNode, tmp_path: Path, sink: str, code: int, reason: str
) -> None:
    command = [str(Path(sys.executable).parent / "foottile"), "stream", "--server", running.url]
    with Play(tared):
        ended = subprocess.run(
            ["sh", "-c", f'exec "$@" {sink}', "sh", *command, "--frames", "5"],
            stderr=subprocess.PIPE,
            text=True,
            cwd=tmp_path,
            timeout=PATIENCE_S,
        )
    assert ended.returncode == code
    assert len(ended.stderr.splitlines()) == code
    assert reason in ended.stderr
