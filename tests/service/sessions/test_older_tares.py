"""Tares that an older version wrote, without hashes: read, called unproven, or lost."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from service.sessions.tares import TareHistory
from storage.checksummed_json import read_checksummed_json
from tests.service.sessions.tares import INFO, as_older, history, same, tare


def assert_lost(path: Path) -> None:
    found = TareHistory(path)
    assert found.tares == []
    assert found.tare_in_force(INFO) is None
    assert found.is_tare_lost(INFO)
    assert [tare.is_lost for tare in found.tares_between(INFO, 0, 9)] == [True]
    assert path.with_name("tares.json.damaged-1").exists()
    assert found.problem is not None
    assert "tares.json.damaged-1" in found.problem


def test_tares_of_an_older_version_are_read_called_unproven_and_written_with_hashes(
    tmp_path: Path,
) -> None:
    before = history(tmp_path, 1, 2).tares
    path = tmp_path / "node" / "tares.json"
    as_older(path)
    found = TareHistory(path)
    for one, other in zip(before, found.tares, strict=True):
        same(one, other)
    assert found.problem is not None
    assert "unproven" in found.problem
    again = TareHistory(path)
    assert again.problem is None
    assert read_checksummed_json(path).has_checksum


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
    "words for chips": {"chips": [["a"], ["b"]]},
    "a number for chips": {"chips": 7},
    "a number for serials": {"serials": 7},
}


@pytest.mark.parametrize("change", DAMAGES.values(), ids=DAMAGES.keys())
def test_an_older_list_with_what_is_no_tare_of_its_tiles_is_lost(
    tmp_path: Path, change: dict[str, Any]
) -> None:
    history(tmp_path, 1)
    path = tmp_path / "node" / "tares.json"

    def changed(content: Any) -> None:
        for name, value in change.items():
            content[0][name] = content[0][name] | value if name == "tare" else value

    as_older(path, changed)
    assert_lost(path)


@pytest.mark.parametrize(
    "missing", ["id", "serials", "undone", "tare", "baseline_kpa", "t_ns", "source", "frames"]
)
def test_an_older_list_with_a_tare_that_lacks_something_is_lost(
    tmp_path: Path, missing: str
) -> None:
    history(tmp_path, 1)
    path = tmp_path / "node" / "tares.json"

    def without(content: Any) -> None:
        del (content[0] if missing in content[0] else content[0]["tare"])[missing]

    as_older(path, without)
    assert_lost(path)


def test_tares_of_an_older_version_have_no_temperature_and_are_readable(tmp_path: Path) -> None:
    history(tmp_path, 1)
    path = tmp_path / "node" / "tares.json"

    def without(content: Any) -> None:
        del content[0]["tare"]["temperature_raw_counts"]

    as_older(path, without)
    (old,) = history(tmp_path).tares
    assert np.isnan(old.tare.temperature_raw_counts).tolist() == [True, True]
    history(tmp_path).add_tare(tare(2), INFO)  # and can be written again, as JSON that has no NaN
    json.loads(path.read_bytes(), parse_constant=pytest.fail)
    assert np.isnan(history(tmp_path).tares[0].tare.temperature_raw_counts).all()
