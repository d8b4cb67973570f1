"""The benchmark of hard cases still runs. What it measures is in docs/results/hard_cases.md."""

from __future__ import annotations

import importlib
from collections import Counter
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from scipy.stats import chi2

from devices.flags import FrameFlag
from devices.frames import FrameBatch, allocate_columns

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


@pytest.mark.slow
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
    columns = allocate_columns(n, 1, np.dtype(np.uint16))
    columns["seq"][:] = np.arange(n)
    columns["frame_flags"][: n // 2] = FrameFlag.LEAD
    left = hard.without(FrameBatch(**columns), 0.1, np.random.default_rng(1))
    gaps = np.diff(left.seq.astype(int)) - 1
    assert (left.seq[: n // 2] == np.arange(n // 2)).all()
    assert 0.05 < 1.0 - (len(left) - n // 2) / (n // 2) < 0.15
    assert gaps[gaps > 0].min() >= 50


def test_alarms_are_added_up_with_the_bound_that_their_hours_allow(hard: ModuleType) -> None:
    stuck, clipped, lost = hard.JUDGED
    a = hard.Alarms(2.0, Counter({stuck: 1, clipped: 2}), 7.5)
    b = hard.Alarms(1.0, Counter({lost: 3}), 8.25)
    lines = list(hard.alarm_lines({("a", 0.0): a, ("b", 0.1): b}))
    assert lines[1] == "| b | 10 % | 1.00 | 0 | 0 | 3 | < 2.97 | 8.2 |"
    assert lines[2] == "| all | - | 3.00 | 1 | 2 | 3 | < 2.09 | 8.2 |"


@pytest.mark.parametrize("alarms", [0, 1, 5, 50])
def test_a_rate_is_bounded_as_that_of_a_poisson_process(hard: ModuleType, alarms: int) -> None:
    exact = 0.5 * chi2.ppf(0.95, 2 * (alarms + 1))
    assert hard.most_per_hour(alarms, 4.0) == pytest.approx(exact / 4.0, rel=0.02)


@pytest.mark.slow
def test_a_healthy_foot_has_a_line_for_each_share_of_lost_frames(
    hard: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hard, "NOISES", ({},))
    monkeypatch.setattr(hard, "LADDERS", {"static": hard.LADDERS["static"]})
    lines = list(hard.healthy(Path(), 0.006, [0.0, 0.1], ["rolling"]))
    assert [line.split("|")[1:7] for line in lines[:2]] == [
        [" rolling ", f" {lost} % ", " 0.01 ", " 0 ", " 0 ", " 0 "] for lost in (0, 10)
    ]
