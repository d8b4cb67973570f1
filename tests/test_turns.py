"""What is slow and hardly ever changes is played by one run of continuous integration in four."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

import tests.conftest


@pytest.mark.parametrize("name", ["test_in_firefox.py", "test_dask_cluster.py", "test_matlab.py"])
def test_a_file_in_turn_is_played_once_in_four_runs_and_always_without_a_turn(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    item = SimpleNamespace(path=Path(name))
    played = []
    for turn in [*map(str, range(101, 105)), None]:
        monkeypatch.setattr(tests.conftest, "TURN", turn)
        played.append(tests.conftest.is_of_this_run(item))  # type: ignore[arg-type]  # that much of it is used
    assert sorted(played[:4]) == [False, False, False, True]
    assert played[4]
