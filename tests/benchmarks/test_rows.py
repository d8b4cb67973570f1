"""The benchmarks of a table still run, on few and short data. Nothing here is timed."""

from __future__ import annotations

import importlib
import re
import sys
from pathlib import Path
from typing import Any

import pytest

from storage.formats.writers.registry import FORMATS

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
SOAK = "--soak --nodes 2 --seconds 3 --viewers 2 --download-mb 1 --tiles 64"
RUNS: tuple[tuple[str, str, tuple[str, ...]], ...] = (
    (
        "archive",
        "--only overhead --sessions 3 --seconds 2 --short 2 --turns 1",
        (r"\| bare", r"\| jobs", r"\| overhead"),
    ),
    ("fanout", "2 0.5 1", (r"\| ours .* \d+ \|", r"\| uvicorn .*", r"\| websockets .*")),
    ("file_bytes", "--seconds 4 --real-s 0 --no-ladder", (r"\| `pressure_raw` .*\d", r"\| .*all ")),
    ("first_bar", "1", (r"\| \d+\.\d\d \(",)),
    ("formats", "--minutes 1 --tiles 2 --only mat", (r"\| mat .*\d",)),
    (
        "many_nodes",
        "--nodes 1 2 --seconds 0.5",
        (r"\| 1 ", r"\| 2 ", r"(?s:.* frames 0 are lost){2}"),
    ),
    ("many_nodes", SOAK, (r"\| 2 ", ".*downloaded 1 MB", r"(?s:.*: complete){2}")),
    ("many_sessions", "3 5", (r"\| 3 ", r"\| 5 ")),
    ("pace", "0.2", (r"\| standing, 4 tiles \| pipelined \|",)),
    (
        "query",
        "--sessions 3 --turns 1 --hops-s 1.5 --long-s 3",
        (r"\| 3 \| sessions only +\| 2 \|", r"\| 3 \| all columns of a second of it +\| \d"),
    ),
    ("slices", "--hours 0.03 --turns 1", (r"\| 0.0333333 h \| REST", r"\| 2 min \|")),
    ("start", "1", (r"\| `foottile --help` \|",)),
    ("step_speed", "20", (r"\| 4 \| static ", r"\| 64 \| static ")),
)
"""Script, arguments, and the beginnings of lines that it prints."""
_PROCESSES = [pytest.mark.slow, pytest.mark.process]
MARKS = {
    "fanout": [*_PROCESSES, pytest.mark.real_time],
    "first_bar": _PROCESSES,
    "formats": _PROCESSES,
    "many_nodes": [*_PROCESSES, pytest.mark.real_time],
    **{name: [pytest.mark.slow] for name in ("archive", "file_bytes", "query", "slices")},
}
SHORTER: dict[str, tuple[str, Any]] = {
    "many_nodes": ("SETTLE_S", 0.5),
    "pace": ("SCENES", 1),
    "start": ("ROWS", 1),
    "step_speed": ("RUNS", 1),
}
"""Numbers, and how many rows of a table, that no argument chooses."""


@pytest.mark.parametrize(
    ("name", "arguments", "expected"),
    [pytest.param(*run, marks=MARKS.get(run[0], ())) for run in RUNS],
)
def test_a_benchmark_prints_its_rows(
    name: str,
    arguments: str,
    expected: tuple[str, ...],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    script = importlib.import_module(name)
    if name in SHORTER:
        constant, value = SHORTER[name]
        if isinstance(table := getattr(script, constant), dict):
            value = dict(list(table.items())[:value])
        monkeypatch.setattr(script, constant, value)
    monkeypatch.setattr(sys, "argv", [f"{name}.py", *arguments.split()])
    script.main()
    printed = capsys.readouterr().out
    for line in expected:
        assert re.search(f"^{line}", printed, re.MULTILINE), printed


def test_every_format_has_a_goal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    formats = importlib.import_module("formats")
    assert set(formats.variants([])) == set(formats.GOALS)
    assert set(FORMATS) < set(formats.GOALS)
