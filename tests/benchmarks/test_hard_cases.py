"""The benchmark of hard cases still runs. What it measures is in docs/results/hard_cases.md."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType

import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture
def hard(monkeypatch: pytest.MonkeyPatch, bench_cache: Path) -> ModuleType:
    monkeypatch.setenv("XDG_CACHE_HOME", str(bench_cache))
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module("hard_cases")


def test_a_case_is_a_row_with_what_it_was_without_the_watch(
    hard: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    frozen = hard.Case("frozen", hard.on_tile("frozen", 1.0))
    monkeypatch.setattr(hard, "cases", lambda: [frozen])
    (line,) = hard.rows(7.0)
    columns = [column.strip() for column in line.strip("|").split("|")]
    assert columns[:2] == ["frozen", "whole"]
    assert float(columns[2]) > 3.0
    assert int(columns[4]) < int(columns[3])
    assert "`stuck`" in columns[5]
    assert 0.0 < float(columns[6]) < 0.1
