"""The benchmark of hard cases still runs. What it measures is in docs/results/hard_cases.md."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from devices.frames import FrameBatch, FrameStatus, zero_columns

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture
def hard(monkeypatch: pytest.MonkeyPatch, bench_cache: Path) -> ModuleType:
    monkeypatch.setenv("XDG_CACHE_HOME", str(bench_cache))
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module("hard_cases")


def test_the_walk_has_steps_that_differ_and_flight_between_them(hard: ModuleType) -> None:
    trace = hard.walk(12.0)
    tops_n = [trace.cells_n[trace.time_s // 1.2 == k].max() for k in range(10)]
    assert min(tops_n) >= 9.0
    assert max(tops_n) <= 17.0
    assert np.std(tops_n) > 0.3
    assert (trace.cells_n[trace.time_s % 1.2 > 0.61] == 0.0).all()


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


def test_frames_are_lost_a_tenth_of_a_second_at_a_time_and_never_of_the_lead(
    hard: ModuleType,
) -> None:
    n = 20_000
    columns = zero_columns(n, 1)
    columns["seq"][:] = np.arange(n)
    columns["frame_status"][: n // 2] = FrameStatus.LEAD
    (left,) = hard.without([FrameBatch(**columns)], 0.1, seed=1)
    gaps = np.diff(left.seq.astype(int)) - 1
    assert (left.seq[: n // 2] == np.arange(n // 2)).all()
    assert 0.05 < 1.0 - (len(left) - n // 2) / (n // 2) < 0.15
    assert gaps[gaps > 0].min() >= 50


def test_alarms_are_counted_as_onsets_and_added_up(hard: ModuleType) -> None:
    lines = list(hard.alarm_lines({"a": [0.5, 1.0, 0.0, 2.0], "b": [0.25, 0.0, 1.0, 0.0]}))
    assert lines[-1] == "| all | 0.75 | 1 | 1 | 2 |"
