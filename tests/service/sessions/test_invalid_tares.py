"""Lines of tares with a right hash and impossible content: lost."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from service.sessions.tares import TareHistory
from tests.service.sessions.tares import INFO, history, rewrite


def assert_lost(path: Path) -> None:
    found = TareHistory(path)
    assert found.all_tares_with_undone == []
    assert found.tare_in_force_unless_lost(INFO) is None
    assert found.is_tare_lost(INFO)
    assert [tare.is_lost for tare in found.tares_in_force_or_lost_between(INFO, 0, 9)] == [True]
    assert path.with_name("tares.json.damaged-1").exists()
    assert found.problem is not None
    assert "tares.json.damaged-1" in found.problem


DAMAGES: dict[str, dict[str, Any]] = {
    "a baseline less": {"tare": {"baseline_kpa": [100.0]}},
    "a baseline that is not known": {"tare": {"baseline_kpa": [100.0, None]}},
    "words for baselines": {"tare": {"baseline_kpa": "none"}},
    "no baselines": {"tare": {"baseline_kpa": None}},
    "noise that is no number": {"tare": {"noise_kpa": [1.0, float("nan")]}},
    "one noise for all": {"tare": {"noise_kpa": 1.0}},
    "a temperature too many": {"tare": {"temperature_raw_counts": [1.0, 2.0, 3.0]}},
    "words for temperatures": {"tare": {"temperature_raw_counts": ["warm", "cold"]}},
    "another shape": {"tare": {"baseline_sigma_kpa": [[1.0, 1.0]]}},
    "words for an instant": {"tare": {"t_ns": "yesterday"}},
    "no instant": {"tare": {"t_ns": None}},
    "an instant of no time": {"tare": {"t_ns": 2**63}},
    "a source that is none": {"tare": {"source": "flighu"}},
    "other tiles": {"serials": ["T01", "T02", "T03"]},
    "no chips": {"chips": None},
    "no temperature": {"tare": {"temperature_raw_counts": [None, None]}},
    "words for chips": {"chips": [["a"], ["b"]]},
    "a number for chips": {"chips": 7},
    "a number for serials": {"serials": 7},
}


@pytest.mark.parametrize("change", DAMAGES.values(), ids=DAMAGES.keys())
def test_what_is_no_tare_of_its_tiles_is_lost(tmp_path: Path, change: dict[str, Any]) -> None:
    history(tmp_path, 1)
    path = tmp_path / "node" / "tares.json"

    def changed(content: Any) -> None:
        for name, value in change.items():
            content[0][name] = content[0][name] | value if name == "tare" else value

    rewrite(path, changed)
    assert_lost(path)


@pytest.mark.parametrize(
    "missing",
    ["id", "serials", "undone", "reason", "chips", "tare", "baseline_kpa", "t_ns", "noise_lasting"],
)
def test_a_tare_that_lacks_something_is_lost(tmp_path: Path, missing: str) -> None:
    history(tmp_path, 1)
    path = tmp_path / "node" / "tares.json"

    def without(content: Any) -> None:
        del (content[0] if missing in content[0] else content[0]["tare"])[missing]

    rewrite(path, without)
    assert_lost(path)
