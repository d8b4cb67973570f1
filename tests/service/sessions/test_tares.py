"""Tares of a node: the newest that was not undone is in force, also after a restart."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.errors import StorageError, UnknownError
from service.sessions.tares import KEPT_MAX, TareHistory
from tests.service.sessions.tares import INFO, OTHERS, array, history, instants, same, tare
from tests.storage.faulty_disk import NO_SPACE, refusing

# --- in force -------------------------------------------------------------------------------------


def test_a_node_that_was_never_tared_has_none(tmp_path: Path) -> None:
    tares = history(tmp_path)
    assert tares.tare_in_force_unless_lost(INFO) is None
    assert tares.all_tares_with_undone == []
    assert tares.tares_in_force_or_lost_between(INFO, 0, 100) == ()
    assert list(tmp_path.iterdir()) == []


def test_the_newest_is_in_force_and_undone_the_one_before(tmp_path: Path) -> None:
    tares = history(tmp_path)
    one, two, three = (tares.store_tare_in_force(tare(t), INFO) for t in (1, 2, 3))
    assert tares.tare_in_force_unless_lost(INFO) is three
    tares.undo_tare(three.id)
    same_as_two = tares.tare_in_force_unless_lost(INFO)
    assert same_as_two is not None
    same(same_as_two, two)
    tares.undo_tare(one.id)  # one that is not in force, too
    assert [recorded.undone for recorded in tares.all_tares_with_undone] == [True, False, True]
    tares.undo_tare(two.id)
    assert tares.tare_in_force_unless_lost(INFO) is None
    again = tares.store_tare_in_force(tare(4), INFO)
    assert tares.tare_in_force_unless_lost(INFO) is again


def test_only_a_known_tare_that_was_not_undone_can_be_undone(tmp_path: Path) -> None:
    tares = history(tmp_path, 1)
    recorded = tares.all_tares_with_undone[0]
    tares.undo_tare(recorded.id)
    for tare_id in (recorded.id, "", "nothing", recorded.id[:-1]):
        with pytest.raises(UnknownError, match="could be undone"):
            tares.undo_tare(tare_id)
    assert len(tares.all_tares_with_undone) == 1


def test_tares_of_other_tiles_do_not_count(tmp_path: Path) -> None:
    tares = history(tmp_path, 1)
    mine = tares.all_tares_with_undone[0]
    for number, info in enumerate(OTHERS):
        tares.store_tare_in_force(tare(10 + number, tiles=len(info.tiles)), info)
    assert tares.tare_in_force_unless_lost(INFO) is mine
    assert instants(tares.tares_in_force_or_lost_between(INFO, 0, 100)) == [1]
    for number, info in enumerate(OTHERS):
        assert instants(tares.tares_in_force_or_lost_between(info, 0, 100)) == [10 + number]


def test_a_tare_does_not_count_for_a_part_that_was_swapped(tmp_path: Path) -> None:
    tares = history(tmp_path, 1)
    other = INFO.tiles[1].model_copy(update={"registers": (1790 * 8, 0xC000, 0, 0)})
    swapped = INFO.model_copy(update={"tiles": (INFO.tiles[0], other)})
    assert tares.tare_in_force_unless_lost(swapped) is None
    assert tares.tares_in_force_or_lost_between(swapped, 0, 100) == ()
    tares.store_tare_in_force(tare(2), swapped)
    assert instants(history(tmp_path).tares_in_force_or_lost_between(INFO, 0, 100)) == [1]


def test_ids_are_all_different(tmp_path: Path) -> None:
    tares = history(tmp_path, *range(30))
    assert len({recorded.id for recorded in tares.all_tares_with_undone}) == 30


def test_the_list_of_tares_is_no_handle_on_the_history(tmp_path: Path) -> None:
    tares = history(tmp_path, 1)
    tares.all_tares_with_undone.clear()
    assert len(tares.all_tares_with_undone) == 1


# --- during an interval ---------------------------------------------------------------------------


@settings(max_examples=40, deadline=None)
@given(
    taken=st.lists(st.tuples(st.integers(0, 20), st.booleans()), max_size=6).map(sorted),
    begin=st.integers(-1, 21),
    length=st.integers(0, 22),
)
def test_an_interval_has_the_tares_that_were_in_force_at_some_time_of_it(
    tmp_path_factory: pytest.TempPathFactory, taken: list[tuple[int, bool]], begin: int, length: int
) -> None:
    tares = history(tmp_path_factory.mktemp("during"), *(t for t, _ in taken))
    for recorded, (_, undone) in zip(tares.all_tares_with_undone, taken, strict=True):
        if undone:
            tares.undo_tare(recorded.id)
    valid = [t for t, undone in taken if not undone]
    in_force = set[int]()
    for instant in range(begin, begin + length + 1):
        before = [t for t in valid if t <= instant]
        in_force |= {before[-1]} if before else set()
    found = instants(tares.tares_in_force_or_lost_between(INFO, begin, begin + length))
    assert sorted(set(found)) == sorted(in_force)
    assert found == sorted(found)


# --- why, and automatic ones ----------------------------------------------------------------------


def test_every_tare_has_a_reason_in_words(tmp_path: Path) -> None:
    tares = history(tmp_path)
    tares.store_tare_in_force(tare(1, source="lead"), INFO)
    tares.store_tare_in_force(tare(2), INFO)
    tares.store_tare_in_force(tare(3), INFO, "new shoe")
    tares.store_tare_in_force(tare(4), INFO, "x" * 500)
    assert [recorded.reason for recorded in history(tmp_path).all_tares_with_undone] == [
        "unloaded lead of the emulation",
        "by hand",
        "new shoe",
        "x" * 200,
    ]


def test_an_undone_tare_pauses_automatic_ones_until_somebody_tares(tmp_path: Path) -> None:
    tares = history(tmp_path, 1)
    assert not tares.is_automatic_paused(INFO)
    one = tares.store_tare_in_force(tare(2, source="flight"), INFO)
    two = tares.store_tare_in_force(tare(3, source="flight"), INFO)
    assert not tares.is_automatic_paused(INFO)
    tares.undo_tare(two.id)
    in_force = tares.tare_in_force_unless_lost(INFO)
    assert in_force is not None
    assert in_force.id == one.id
    assert tares.is_automatic_paused(INFO)
    assert history(tmp_path).is_automatic_paused(INFO), "also after a restart"
    assert not tares.is_automatic_paused(OTHERS[0]), "not for other tiles"
    by_hand = tares.store_tare_in_force(tare(4), INFO)
    assert not tares.is_automatic_paused(INFO)
    tares.undo_tare(by_hand.id)  # else the next automatic one would replace the one restored
    assert tares.is_automatic_paused(INFO)


def test_automatic_tares_are_held_against_the_last_one_by_hand_or_the_oldest(
    tmp_path: Path,
) -> None:
    tares = history(tmp_path)
    assert tares.last_not_in_flight_or_oldest(INFO) is None
    first = tares.store_tare_in_force(tare(1, source="flight"), INFO)
    tares.store_tare_in_force(tare(2, source="flight"), INFO)
    assert tares.last_not_in_flight_or_oldest(INFO) is first
    by_hand = tares.store_tare_in_force(tare(3), INFO)
    tares.store_tare_in_force(tare(4, source="flight"), INFO)
    assert tares.last_not_in_flight_or_oldest(INFO) is by_hand
    tares.undo_tare(by_hand.id)
    anchor = tares.last_not_in_flight_or_oldest(INFO)
    assert anchor is not None
    assert anchor.id == first.id


def test_automatic_tares_never_push_out_one_that_was_taken_by_hand(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.sessions.tares.AUTOMATIC_KEPT_MAX", 20)
    tares = history(tmp_path, 0)
    for t in range(1, 301):
        tares.store_tare_in_force(tare(t, source="unloaded" if t % 100 == 0 else "flight"), INFO)
        assert sum(recorded.is_taken_in_flight for recorded in tares.all_tares_with_undone) <= 20
    assert instants([t.tare for t in tares.all_tares_with_undone if not t.is_taken_in_flight]) == [
        0,
        100,
        200,
        300,
    ]
    kept = instants([t.tare for t in tares.all_tares_with_undone if t.is_taken_in_flight])
    assert kept == sorted(kept)
    assert kept[0] == 1, "the first of them"
    assert set(range(290, 300)) <= set(kept), "the newest without a gap"
    assert max(np.diff(kept)) < 120, "and of what was before some"


# --- kept -----------------------------------------------------------------------------------------


def test_the_history_survives_a_restart_bit_by_bit(tmp_path: Path) -> None:
    tares = history(tmp_path, 1, 2**62)
    tares.store_tare_in_force(tare(5, tiles=1), array("Ü"))
    tares.undo_tare(tares.all_tares_with_undone[1].id)
    again = history(tmp_path)
    assert len(again.all_tares_with_undone) == 3
    for one, other in zip(tares.all_tares_with_undone, again.all_tares_with_undone, strict=True):
        same(one, other)
    in_force = again.tare_in_force_unless_lost(INFO)
    assert in_force is not None
    assert in_force.tare.t_ns == 1
    again.undo_tare(in_force.id)
    assert history(tmp_path).tare_in_force_unless_lost(INFO) is None


def test_only_the_newest_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.sessions.tares.KEPT_MAX", 5)
    tares = history(tmp_path, *range(8))
    assert instants([recorded.tare for recorded in tares.all_tares_with_undone]) == [3, 4, 5, 6, 7]
    assert instants([recorded.tare for recorded in history(tmp_path).all_tares_with_undone]) == [
        3,
        4,
        5,
        6,
        7,
    ]
    assert KEPT_MAX >= 100


def test_a_disk_that_cannot_be_written_leaves_the_history_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tares = history(tmp_path, 1, 2)
    before = tares.all_tares_with_undone
    with monkeypatch.context() as patch:
        patch.setattr("os.fsync", refusing(*NO_SPACE))
        with pytest.raises(StorageError, match="No space left"):
            tares.store_tare_in_force(tare(3), INFO)
        with pytest.raises(StorageError, match="No space left"):
            tares.undo_tare(before[0].id)
    assert tares.all_tares_with_undone == before
    assert tares.tare_in_force_unless_lost(INFO) is before[1]
    assert instants([recorded.tare for recorded in history(tmp_path).all_tares_with_undone]) == [
        1,
        2,
    ]
    assert not any(recorded.undone for recorded in history(tmp_path).all_tares_with_undone)
    tares.store_tare_in_force(tare(4), INFO)
    assert instants([recorded.tare for recorded in history(tmp_path).all_tares_with_undone]) == [
        1,
        2,
        4,
    ]


def test_a_folder_that_cannot_be_made_is_a_storage_error(tmp_path: Path) -> None:
    (tmp_path / "node").write_bytes(b"")
    with pytest.raises(StorageError):
        TareHistory(tmp_path / "node" / "more" / "tares.json").store_tare_in_force(tare(), INFO)
