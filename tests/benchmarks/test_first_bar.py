"""The benchmark of the demo's start sees a bar, and then a force."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.mark.slow
@pytest.mark.process
def test_a_bar_comes_before_the_first_force(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    first_bar = importlib.import_module("first_bar")
    bar_s, force_s, cpu_s = first_bar.begun()
    assert 0.0 < bar_s < force_s
    assert cpu_s > 0.0
