"""The benchmark of starts runs, and gives a row for each."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


def test_each_start_has_its_row(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    start = importlib.import_module("start")
    monkeypatch.setattr(start, "ROWS", dict(list(start.ROWS.items())[:1]))
    monkeypatch.setattr(sys, "argv", ["start.py", "1"])
    start.main()
    assert "| `foottile --help` |" in capsys.readouterr().out
