"""`foottile stream`: live frames as lines, which end quietly."""

from __future__ import annotations

import csv
import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.service.fake_node import FakeNode, Play
from tests.service.process import Start
from tests.service.running import Running
from tests.waiting import PATIENCE_S, until

COLUMNS = ["seq", "t_ns", "grf_n", "recomputed"]


def test_lines_are_csv_or_json_one_for_each_frame_in_order(
    running: Running, tared: FakeNode, foottile: Start
) -> None:
    with Play(tared, 20.0):
        asked = ("stream", "bench", "--columns", "grf_n", "--frames", 40, "--server", running.url)
        as_csv, as_json = foottile(*asked), foottile(*asked, "--format", "jsonl")
        assert as_csv.ended(PATIENCE_S) == as_json.ended(PATIENCE_S) == 0
    table = [*csv.reader(as_csv.out)]
    assert table[0] == COLUMNS
    rows = [json.loads(line) for line in as_json.out]
    assert all([*row] == COLUMNS for row in rows)
    for seqs in ([int(row[0]) for row in table[1:]], [row["seq"] for row in rows]):
        assert seqs == list(range(seqs[0], seqs[0] + 40))
    assert not as_csv.err
    assert not as_json.err


def test_ctrl_c_ends_it_without_a_word(running: Running, tared: FakeNode, foottile: Start) -> None:
    with Play(tared):
        process = foottile("stream", "--server", running.url)
        until(lambda: len(process.out) > 2)
        process.process.send_signal(signal.SIGINT)
        assert process.ended(PATIENCE_S) == 0
    assert not process.err


def test_it_ends_without_a_word_when_its_reader_goes_away(
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


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (("nobody",), 2, "no node 'nobody'"),
        (("bench", "--columns", "grf_n_sigma"), 2, "did you mean 'grf_sigma_n'?"),
        (("bench", "--format", "xml"), 2, "expected csv or jsonl"),
        (("--server", "http://127.0.0.1:1"), 1, "no answer"),
    ],
)
def test_what_cannot_be_is_one_line_and_a_code(
    running: Running,
    tared: FakeNode,
    foottile: Start,
    arguments: tuple[str, ...],
    code: int,
    said: str,
) -> None:
    process = foottile("stream", "--server", running.url, *arguments)
    assert process.ended(PATIENCE_S) == code
    assert len(process.err) == 1
    assert said in process.err[0]


@pytest.mark.parametrize(
    ("sink", "code", "said"), [("> /dev/full", 1, "No space left on device"), (">&-", 0, "")]
)
def test_where_nothing_can_be_written_it_ends_and_says_why_if_it_was_to_be_written(
    running: Running, tared: FakeNode, tmp_path: Path, sink: str, code: int, said: str
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
    assert said in ended.stderr
