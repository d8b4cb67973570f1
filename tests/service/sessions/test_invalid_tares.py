"""Lines of tares with a right hash and impossible content: lost."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from service.sessions.tares import TareHistory
from tests.service.sessions.tares import INFO, history, rewrite

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


MISSING = (
    "id",
    "serials",
    "undone",
    "reason",
    "chips",
    "tare",
    "baseline_kpa",
    "t_ns",
    "noise_lasting",
)


@pytest.mark.parametrize("damage", [*DAMAGES, *MISSING])
def test_an_impossible_or_incomplete_tare_is_lost(tmp_path: Path, damage: str) -> None:
    history(tmp_path, 1)
    path = tmp_path / "node" / "tares.json"

    def changed(content: Any) -> None:
        for name, value in DAMAGES.get(damage, {}).items():
            content[0][name] = content[0][name] | value if name == "tare" else value
        if damage in MISSING:
            del (content[0] if damage in content[0] else content[0]["tare"])[damage]

    rewrite(path, changed)
    found = TareHistory(path)
    assert found.all_tares_with_undone == []
    assert found.tare_in_force_unless_lost(INFO) is None
    assert found.is_tare_lost(INFO)
    assert [tare.is_lost for tare in found.tares_in_force_or_lost_between(INFO, 0, 9)] == [True]
    assert path.with_name("tares.json.damaged-1").exists()
    assert found.problem is not None
    assert "tares.json.damaged-1" in found.problem
