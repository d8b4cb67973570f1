"""Damage in a session's folder is found, file by file."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from storage.checksummed_json import verify_and_strip_json_checksum
from storage.verify.data_folder import find_verdict, verify_path
from storage.verify.session import verify_session
from tests.storage.verify.folders import (
    EVENTS,
    ID,
    OTHER_ID,
    edited,
    in_ledger,
    problems,
    raised,
    sealed,
)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("frames.parquet", "frames.parquet is missing"),
        ("session.json", "session.json is missing"),
        ("markers.parquet", "markers.parquet is missing"),
        ("clock.parquet", "clock.parquet is missing"),
    ],
)
def test_a_file_that_is_missing_is_damage(tmp_path: Path, name: str, said: str) -> None:
    folder = sealed(tmp_path)
    (folder / name).unlink()
    assert said in problems(folder)
    report = verify_session(folder)
    assert report.to_json_dict()["id"] == ID
    assert find_verdict(report) == "damaged"


@pytest.mark.parametrize("name", ["session.json", "frames.parquet", "markers.parquet"])
def test_a_file_of_another_session_in_its_place_is_seen(tmp_path: Path, name: str) -> None:
    one = sealed(tmp_path / "one")
    two = sealed(tmp_path / "two", OTHER_ID, markers=(EVENTS[0].model_copy(update={"id": "e2"}),))
    shutil.copy(two / name, one / name)
    assert problems(one)
    assert problems(two) == ""


def test_a_session_in_another_one_s_folder_is_seen(tmp_path: Path) -> None:
    folder = sealed(tmp_path)
    folder.rename(folder.with_name(OTHER_ID))
    report = verify_path(tmp_path)
    assert any("lies in the folder of" in said for said in report.to_json_dict()["problems"])


@settings(max_examples=120, deadline=None)
@given(st.data())
def test_one_flipped_bit_in_its_description_or_frames_is_found(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    base = tmp_path_factory.getbasetemp() / "flipped_session"
    folder = base / "sessions" / ID
    if not folder.exists():
        sealed(base)
    path = folder / data.draw(st.sampled_from(["session.json", "frames.parquet"]))
    whole = path.read_bytes()
    content = bytearray(whole)
    at = data.draw(st.integers(0, len(content) - 1))
    content[at] ^= 1 << data.draw(st.integers(0, 7))
    try:
        path.write_bytes(content)
        assert verify_session(folder).problems != []
    finally:
        path.write_bytes(whole)


@pytest.mark.parametrize("name", ["session.json", "frames.parquet"])
def test_a_file_that_was_cut_anywhere_is_damage(tmp_path: Path, name: str) -> None:
    path = sealed(tmp_path) / name
    whole = path.read_bytes()
    for size in (*range(0, len(whole), 211), len(whole) - 1):
        path.write_bytes(whole[:size])
        assert verify_session(path.parent).problems != [], size


def test_a_damaged_or_exchanged_file_is_one_finding(tmp_path: Path) -> None:
    path = sealed(tmp_path) / "frames.parquet"
    whole = path.read_bytes()
    other = (sealed(tmp_path, OTHER_ID) / "frames.parquet").read_bytes()
    for content in (whole + b"x", whole[:300] + b"x" + whole[301:], other, b"x"):
        path.write_bytes(content)
        (problem,) = verify_session(path.parent).problems
        assert problem.startswith("frames.parquet")
        assert (f"it is of session {OTHER_ID}" in problem) == (content == other)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (raised("id", OTHER_ID), "says id"),
        (raised("node", "other"), "says node"),
        (raised("frames", 54), "says frames 54"),
        (raised("bytes", 54), "says bytes 54"),
        (raised("sha256", "0" * 64), "not the file that session.json names"),
        (raised("sha256", None), "not the file that session.json names"),
        (raised("duration_s", 3.0), "lasted 3.0 s"),
        (raised("stopped_t_ns", 5), "says stopped_t_ns"),
        (raised("calibration_id", "x"), "says calibration_id"),
        (raised("absolute_scale", "measured"), "says absolute_scale"),
        (raised("ledger", None), "its ledger is missing"),
        (raised("markers", []), "other events"),
        (lambda c: c["clock"][0].update(uncertainty_ns=4), "clock.parquet has other rows"),
        (in_ledger("recorded", 40), "ledgers of session.json and frames.parquet"),
        (in_ledger("lost", {}), "ledgers of session.json and frames.parquet"),
        (in_ledger("pending", 5), "still to come"),
        (lambda c: c["parts"].pop(), "not of the same parts"),
        (lambda c: c["parts"][0].update(seq_last=50), "not of the same parts"),
    ],
)
def test_an_edit_that_forges_the_check_is_held_against_the_file(
    tmp_path: Path, change: Any, said: str
) -> None:
    folder = sealed(tmp_path)
    edited(folder, change)
    assert said in problems(folder)


def test_an_edited_note_is_seen_by_the_check_alone(tmp_path: Path) -> None:
    folder = sealed(tmp_path)
    path = folder / "session.json"
    text = path.read_bytes()
    path.write_bytes(text.replace(b"first try", b"third try"))
    assert "was changed" in problems(folder)
    path.write_bytes(verify_and_strip_json_checksum(text, where=""))
    assert "no hash" in problems(folder)


def test_a_damaged_table_beside_it_is_seen(tmp_path: Path) -> None:
    folder = sealed(tmp_path)
    for name in ("markers.parquet", "clock.parquet"):
        whole = (folder / name).read_bytes()
        (folder / name).write_bytes(whole[:-9])
        assert name in problems(folder)
        pq.write_table(pq.read_table(folder / "frames.parquet").select(["seq"]), folder / name)
        assert name in problems(folder)
        (folder / name).write_bytes(whole)
