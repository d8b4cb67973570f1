"""The benchmark of many sessions runs, and gives a row for each number asked for."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


def test_each_number_of_sessions_has_its_row(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    many_sessions = importlib.import_module("many_sessions")
    monkeypatch.setattr(sys, "argv", ["many_sessions.py", "3", "5"])
    many_sessions.main()
    rows = capsys.readouterr().out.splitlines()[2:]
    assert [row.split()[1] for row in rows] == ["3", "5"]
