"""The benchmark of slices still runs, and all its ways give the same numbers. Nothing is timed."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


def test_every_way_to_a_slice_is_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    slices = importlib.import_module("slices")
    lines = slices.report(tmp_path, [2], 1)  # it asserts that the numbers are the same
    assert [line for line in lines if line.startswith("| 0.0333333 h | REST")]
    assert [line for line in lines if line.startswith("| 2 min |")]
