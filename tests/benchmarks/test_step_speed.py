"""The benchmark of steps still runs, with a row for each ladder. Nothing is timed."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


def test_each_ladder_has_its_row_for_a_foot_and_for_a_grid(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    step_speed = importlib.import_module("step_speed")
    monkeypatch.setattr(step_speed, "RUNS", 1)
    monkeypatch.setattr(sys, "argv", ["step_speed.py", "20"])
    step_speed.main()
    rows = [line.split(" | ")[:2] for line in capsys.readouterr().out.splitlines()[2:]]
    names = list(step_speed.LADDERS)
    assert rows == [[f"| {tiles}", name] for tiles in (4, 64) for name in names]
