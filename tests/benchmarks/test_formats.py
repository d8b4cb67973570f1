"""The benchmark of formats runs, and every format has a row with a size."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

from storage.formats.writers.registry import FORMATS

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
pytestmark = [pytest.mark.slow, pytest.mark.process]


def test_a_format_has_a_row_and_every_format_a_goal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    formats = importlib.import_module("formats")
    assert set(formats.variants([])) == set(formats.GOALS)
    assert set(FORMATS) < set(formats.GOALS)
    *_, row = formats.report(1, 2, ["mat"])
    cells = [cell.strip() for cell in row.split("|")]
    assert cells[1] == "mat"
    assert float(cells[5]) > 0
