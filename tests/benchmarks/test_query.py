"""The benchmark of questions runs, and what it asks is answered from what was made."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


def test_each_question_has_a_row(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    query = importlib.import_module("query")
    sizes = ("--sessions", "3", "--turns", "1", "--hops-s", "1.5", "--long-s", "3")
    monkeypatch.setattr(sys, "argv", ["query.py", *sizes])
    query.main()
    cells = [line.split("|") for line in capsys.readouterr().out.splitlines() if "| 3 |" in line]
    found = {row[2].strip(): int(row[3]) for row in cells}
    assert found.keys() == query.questions(0).keys()
    assert found["sessions only"] == 2
    assert 0 < found["all columns of a second of it"] < found["all columns of it"]
