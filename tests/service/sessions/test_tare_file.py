"""Tares on a damaged disk: what is read is what was written, or known to be lost."""

from __future__ import annotations

import json
import os
import re
import shutil
from pathlib import Path
from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.frames import ArrayInfo
from service.estimation.tare.tare import Tare, TareSource
from service.sessions.tares import TareHistory
from storage.documents import write_checksummed_json
from tests.builders.calibrations import make_tare
from tests.hostile.damages import DAMAGES, NO_FILE
from tests.service.sessions.tares import INFO, array

END = 80


OTHER = array("T03", "T04")
ARRAYS = (INFO, OTHER)
TAKEN: tuple[tuple[int, ArrayInfo, TareSource, bool], ...] = (
    (10, INFO, "lead", False),
    (20, OTHER, "unloaded", False),
    (30, INFO, "flight", True),
    (40, INFO, "unloaded", False),
    (50, INFO, "unloaded", True),
    (60, OTHER, "flight", False),
    (70, INFO, "flight", False),
)


def written(folder: Path, count: int = len(TAKEN)) -> Path:
    path = folder / "tares.json"
    tares = TareHistory(path)
    for t_ns, info, source, undone in TAKEN[:count]:
        tare = make_tare(2, baseline_kpa=100.0 + t_ns / 7, t_ns=t_ns, source=source)
        recorded = tares.store_tare_in_force(tare, info)
        if undone:
            tares.undo_tare(recorded.id)
    return path


def told(tare: Tare | None) -> str:
    return "lost" if tare is not None and tare.is_lost else json.dumps(tare and tare.as_dict())


def in_use(tares: TareHistory) -> dict[str, str]:
    """What is estimated with: now, and at every instant of sessions of every length."""
    found = {}
    for name, info in zip("IO", ARRAYS, strict=True):
        found[f"{name} now"] = told(tares.tare_in_force_or_lost(info))
        lost = any(tare.is_lost for tare in tares.tares_in_force_or_lost_between(info, 0, END))
        found[f"{name} empty"] = "lost" if lost else str(tares.is_empty(info))
        for begin in range(0, END, 20):
            for end in range(begin, END, 20):
                during = tares.tares_in_force_or_lost_between(info, begin + 5, end + 5)
                for t_ns in range(begin, end + 10, 10):
                    until = [tare for tare in during if tare.t_ns < t_ns]
                    used = until[-1] if until else during[0] if during else None
                    found[f"{name} {begin}-{end} {t_ns}"] = told(used)
    return found


def assert_right_or_lost(path: Path, whole: dict[str, str]) -> TareHistory:
    found = TareHistory(path)
    now = in_use(found)
    wrong = {at: (whole[at], now[at]) for at in whole if now[at] not in (whole[at], "lost")}
    assert not wrong
    assert path.is_file()
    again = TareHistory(path)
    assert again.problem is None, "it was mended"
    assert in_use(again) == now
    return found


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[bytes, dict[str, str]]:
    path = written(tmp_path_factory.mktemp("whole"))
    return path.read_bytes(), in_use(TareHistory(path))


def play(folder: Path, text: bytes, whole: dict[str, str]) -> TareHistory:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    (folder / "tares.json").write_bytes(text)
    return assert_right_or_lost(folder / "tares.json", whole)


def test_a_whole_file_is_read_as_it_was_written(
    tmp_path: Path, whole: tuple[bytes, dict[str, str]]
) -> None:
    text, used = whole
    found = play(tmp_path / "n", text, used)
    assert found.problem is None
    assert in_use(found) == used
    assert "lost" not in used.values()


@settings(max_examples=80, deadline=None)
@given(at=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7))
def test_a_flipped_bit_is_noticed_and_gives_the_same_tare_or_a_lost_one_and_never_another(
    tmp_path_factory: pytest.TempPathFactory,
    whole: tuple[bytes, dict[str, str]],
    at: float,
    bit: int,
) -> None:
    text, used = bytearray(whole[0]), whole[1]
    text[int(at * len(text))] ^= 1 << bit
    folder = tmp_path_factory.mktemp("flip") / "n"
    assert play(folder, bytes(text), used).problem is not None
    assert (folder / "tares.json.damaged-1").read_bytes() == text


@settings(max_examples=40, deadline=None)
@given(st.data())
def test_lines_that_are_moved_doubled_or_missing_are_noticed(
    tmp_path_factory: pytest.TempPathFactory,
    whole: tuple[bytes, dict[str, str]],
    data: st.DataObject,
) -> None:
    head, *lines, tail, check, end = whole[0].split(b"\n")
    lines = [line.rstrip(b",") for line in lines]
    assert len(lines) == len(TAKEN)
    some = data.draw(st.lists(st.sampled_from(lines), max_size=9))
    text = b"\n".join([head, b",\n".join(some), tail, check, end])
    found = play(tmp_path_factory.mktemp("lines") / "n", text, whole[1])
    assert some == lines or found.problem is not None
    if set(some) == set(lines):
        assert in_use(found) == whole[1], "their order is known"


@pytest.mark.parametrize("count", [1, 3, len(TAKEN)])
def test_a_file_that_is_cut_off_anywhere_gives_what_is_whole_and_lost_ones(
    tmp_path: Path, count: int
) -> None:
    path = written(tmp_path / "whole", count)
    text, used = path.read_bytes(), in_use(TareHistory(path))
    for length in range(0, len(text), 3 if count == 1 else 29):
        found = play(tmp_path / "cut", text[:length], used)
        assert found.problem is not None
        assert len(found.all_tares_with_undone) == len(
            re.findall(rb'"sha256": "[0-9a-f]{64}"\}', text[:length])
        )


def test_an_older_file_line_of_the_same_place_is_not_believed(tmp_path: Path) -> None:
    older = written(tmp_path / "n", 3).read_bytes().split(b"\n")
    path = written(tmp_path / "m")
    lines = path.read_bytes().split(b"\n")
    lines[2] = older[2]
    path.write_bytes(b"\n".join(lines))
    found = TareHistory(path)
    assert found.all_tares_with_undone == [], "it is not known which of both files it is"
    assert found.is_tare_lost(INFO)


def test_a_tare_after_the_lost_one_puts_all_right_again_and_so_it_stays(tmp_path: Path) -> None:
    path = written(tmp_path / "n")
    text = path.read_bytes()
    path.write_bytes(text.replace(b'"number": 6', b'"number": 7'))
    found = TareHistory(path)
    assert found.tare_in_force_or_lost(OTHER) is not None
    assert found.is_tare_lost(INFO)
    assert found.is_tare_lost(OTHER), "it is not known whose it was"
    assert found.last_not_in_flight_or_oldest(INFO) is None
    assert not found.is_empty(INFO)
    mine = found.store_tare_in_force(make_tare(2, t_ns=90, source="flight"), INFO)
    for tares in (found, TareHistory(path)):
        assert tares.problem is None or tares is found
        in_force = tares.tare_in_force_unless_lost(INFO)
        assert in_force is not None
        assert in_force.id == mine.id
        assert not tares.is_tare_lost(INFO)
        assert tares.is_tare_lost(OTHER)
        assert [
            (t.t_ns, t.is_lost) for t in tares.tares_in_force_or_lost_between(INFO, 75, 95)
        ] == [(75, True), (90, False)]
    found.undo_tare(mine.id)
    assert found.is_tare_lost(INFO), "none that is older takes its place"


CONTENTS = (
    *(b"", b"[]", b"null", b"7", b'"tares"', b"{}", b"[7]", b"[null]", b"\xff", b"[1e999]"),
    *(b"[" * 100_000, b'{"tares": []}', b'{"tares": [' + b"[" * 100_000),
)


@pytest.mark.parametrize("damage", NO_FILE)
def test_a_place_that_is_no_file_is_set_aside_and_all_is_lost(tmp_path: Path, damage: str) -> None:
    path = written(tmp_path / "n")
    whole = in_use(TareHistory(path))
    DAMAGES[damage](path, Random())  # noqa: S311  # draws nothing for these
    found = assert_right_or_lost(path, whole)
    assert found.all_tares_with_undone == []
    assert os.path.lexists(path.with_name("tares.json.damaged-1"))


@pytest.mark.parametrize("content", CONTENTS, ids=lambda c: repr(c[:12]))
def test_a_foreign_text_is_set_aside_and_all_is_lost(tmp_path: Path, content: bytes) -> None:
    path = written(tmp_path / "n")
    whole = in_use(TareHistory(path))
    path.write_bytes(content)
    found = assert_right_or_lost(path, whole)
    assert found.all_tares_with_undone == []
    assert found.problem is not None
    assert str(path) in found.problem


def test_a_file_that_was_set_aside_alone_means_lost_and_not_none(tmp_path: Path) -> None:
    path = written(tmp_path / "n")
    path.rename(path.with_name("tares.json.damaged-1"))
    assert TareHistory(path).is_tare_lost(INFO)


def test_tares_of_a_later_version_are_set_aside_and_lost(tmp_path: Path) -> None:
    path = written(tmp_path / "n")
    later = TareHistory(path)
    write_checksummed_json(path, b'{"baselines": []}')
    assert TareHistory(path).is_tare_lost(INFO)
    assert later.all_tares_with_undone
