"""Slow tests are played in turn: each once in four runs, the slowest once in eight."""

from __future__ import annotations

import gc
from collections.abc import Collection
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import tests.conftest

NAMES = ("test_one", "test_two", "test_three", "test_four")
"""Of tests that are not all played by the same run."""


@pytest.mark.parametrize("file", ["test_in_firefox.py", "test_dask_cluster.py", "test_matlab.py"])
def test_a_file_in_turn_is_played_whole_once_in_four_runs(
    file: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, *others = (_play(file, name, {"in_turn", "slow"}, monkeypatch) for name in NAMES)
    assert sorted(first) == [False, False, False, True]
    assert others == [first] * 3


def test_a_slow_test_is_played_once_in_four_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    played = [_play("test_a.py", name, {"slow"}, monkeypatch) for name in NAMES]
    assert all(sorted(each) == [False, False, False, True] for each in played)
    assert len({tuple(each) for each in played}) > 1


def test_one_of_the_slowest_is_played_once_in_eight_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    played = [_play("test_a.py", name, {"slow"}, monkeypatch, parts=8) for name in NAMES]
    assert all(sorted(each) == [False] * 7 + [True] for each in played)
    assert len({tuple(each) for each in played}) > 1


def test_tests_of_the_same_parameters_are_played_together(monkeypatch: pytest.MonkeyPatch) -> None:
    for each in ("pipelined-gone", "per_mux-gone", "1"):
        first, second = (
            _play("test_a.py", f"{name}[{each}]", {"slow"}, monkeypatch)
            for name in ("test_one", "test_two")
        )
        assert first == second


def test_the_search_for_garbage_is_on_while_tests_run_and_leaves_out_what_collection_made() -> None:
    assert gc.isenabled()
    assert gc.get_freeze_count()


def _play(
    file: str,
    name: str,
    marks: Collection[str],
    monkeypatch: pytest.MonkeyPatch,
    parts: int | None = None,
) -> list[bool]:
    """Return which of four, or `parts`, runs in a row play a test; one without a turn has to."""
    mark = SimpleNamespace(kwargs={"parts": parts} if parts else {})
    item: Any = SimpleNamespace(
        path=Path(file), name=name, get_closest_marker=lambda name: mark if name in marks else None
    )
    played = []
    for turn in [None, *map(str, range(101, 101 + (parts or 4)))]:
        monkeypatch.setattr(tests.conftest, "TURN", turn)
        played.append(tests.conftest.is_of_this_run(item))
    assert played[0]
    return played[1:]
