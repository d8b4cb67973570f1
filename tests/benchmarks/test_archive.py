"""The benchmark of plans runs, and says what a job costs beside its estimate."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
pytestmark = pytest.mark.slow


def test_the_overhead_of_a_job_has_a_row(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    archive = importlib.import_module("archive")
    sizes = ("--sessions", "3", "--seconds", "2", "--short", "2", "--turns", "1")
    parts = ("--only", "overhead")
    monkeypatch.setattr(sys, "argv", ["archive.py", *parts, *sizes])
    archive.main()
    rows = [line for line in capsys.readouterr().out.splitlines() if line.startswith("| ")]
    names = {row.split("|")[1].strip() for row in rows}
    assert {"bare", "jobs", "overhead"} <= names
