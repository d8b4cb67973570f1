"""Tests in turn: one run of continuous integration in four plays them."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import tests.conftest


@pytest.mark.parametrize("name", ["test_in_firefox.py", "test_dask_cluster.py", "test_matlab.py"])
def test_a_file_in_turn_is_played_once_in_four_runs_and_always_without_a_turn(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = (
        _play(SimpleNamespace(path=Path(name), name="test_one"), {}, monkeypatch),
        _play(SimpleNamespace(path=Path(name), name="test_two"), {}, monkeypatch),
    )
    assert sorted(first[:4]) == [False, False, False, True]
    assert first == second
    assert first[4]


def test_a_test_in_turn_by_itself_is_played_once_in_four_runs(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    played = [
        _play(SimpleNamespace(path=Path("test_a.py"), name=name), {"each": True}, monkeypatch)
        for name in ("test_one", "test_two", "test_three", "test_four")
    ]
    assert all(sorted(each[:4]) == [False, False, False, True] for each in played)
    assert len({tuple(each) for each in played}) > 1


def _play(item: Any, kwargs: dict[str, bool], monkeypatch: pytest.MonkeyPatch) -> list[bool]:
    """Return whether four runs in a row and one without a turn play a test marked `in_turn`."""
    item.get_closest_marker = lambda _: pytest.mark.in_turn(**kwargs).mark
    played = []
    for turn in [*map(str, range(101, 105)), None]:
        monkeypatch.setattr(tests.conftest, "TURN", turn)
        played.append(tests.conftest.is_of_this_run(item))
    return played
