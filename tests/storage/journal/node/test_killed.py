"""A node that was killed, or lost its power: what it has, and how much may be lost."""

from __future__ import annotations

import json
import time
from contextlib import closing
from pathlib import Path

import pytest

from devices.errors import StorageError
from devices.flags import TileFlag
from storage.documents import read_checksummed_json, write_checksummed_json
from storage.intervals import Intervals
from storage.journal.journal import Journal
from storage.journal.node import in_flight, retention
from storage.journal.node import journal as node_journal
from storage.journal.node.journal import NodeJournal
from storage.journal.node.stream import NodeStream
from storage.journal.stream_notes import StreamNotes
from tests.builders.arrays import make_array
from tests.storage.faulty_disk import before_each_sync_of_frames, refusing
from tests.storage.journal.node.leg import Start, fill, frames, killed, store, take_in_flight
from tests.waiting import until


def test_a_stream_that_ended_is_complete_after_a_restart(
    journal: NodeJournal, stream: NodeStream, start: Start
) -> None:
    fill(journal, stream, 0, 99)
    journal.end_streams_and_close()
    again = start()
    (found,) = again.streams
    assert (found.next_seq, found.notes.max_lost_tail_frames, found.is_complete_on_disk) == (
        100,
        0,
        True,
    )
    assert found.available == Intervals([(0, 99)])
    assert (
        again.switch_to_new_stream(make_array(stream_id="1" * 32)).notes.number
        == found.notes.number + 1
    )


def test_a_killed_node_has_lost_nothing(
    journal: NodeJournal, stream: NodeStream, start: Start, tmp_path: Path
) -> None:
    """What was in the pipe, or in a batch that was being filled, was in flight."""
    store(journal, stream, 0, 99)
    batch = frames(0, 117)
    batch.pressure_raw[110] = 0  # out of range, which is flagged when a batch is whole
    take_in_flight(stream.folder, batch)
    again = NodeJournal(killed(journal, tmp_path), "leg")
    again.start_writer()
    (found,) = again.streams
    assert (found.next_seq, found.notes.max_lost_tail_frames) == (118, 0)
    assert again.wait_for_ended_streams_on_disk()
    assert found.stored == Intervals([(0, 117)])
    assert found.journal is not None
    rescued = next(found.journal.read_frames(110, 110))
    assert (rescued.tile_flags & TileFlag.OVER_RANGE).all()
    assert not (found.folder / "in_flight").exists()
    again.end_streams_and_close()


def test_a_power_cut_costs_at_most_the_stated_tail(
    journal: NodeJournal, stream: NodeStream, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store(journal, stream, 0, 99)
    take_in_flight(stream.folder, frames(0, 117))
    folder = killed(journal, tmp_path)
    monkeypatch.setattr(in_flight, "read_kernel_boot_id", lambda: "another start of the machine")
    again = NodeJournal(folder, "leg")
    (found,) = again.streams
    assert found.next_seq == 100
    assert found.notes.max_lost_tail_frames == 0.5 * 500 + 17
    again.end_streams_and_close()


def test_a_disk_that_was_slower_than_the_promise_widens_the_bound(
    journal: NodeJournal, stream: NodeStream, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        before_each_sync_of_frames(patch, lambda: time.sleep(0.6))
        fill(journal, stream, 0, 9)
        until(lambda: (n := StreamNotes.load(stream.folder)) and n.sync_max_s > 0.6)
    folder = killed(journal, tmp_path)
    again = NodeJournal(folder, "leg")
    assert again.streams[0].notes.max_lost_tail_frames > 0.6 * 500
    again.end_streams_and_close()


def test_a_stream_without_notes_is_found_by_its_frames_in_flight(
    start: Start, tmp_path: Path
) -> None:
    folder = tmp_path / "journal" / "leg" / ("2" * 32)
    take_in_flight(folder, frames(0, 5), make_array(stream_id="2" * 32))
    journal = start()
    (found,) = journal.streams
    assert (found.stream_id, found.next_seq) == ("2" * 32, 6)
    assert journal.wait_for_ended_streams_on_disk()
    assert found.stored == Intervals([(0, 5)])


def test_recovery_stores_frames_in_flight_and_drops_nothing(
    journal: NodeJournal, stream: NodeStream, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store(journal, stream, 0, 99)
    take_in_flight(stream.folder, frames(0, 117))
    folder = killed(journal, tmp_path)
    monkeypatch.setattr(retention, "RING_DURATION_NS", 0)
    monkeypatch.setattr(node_journal, "DEFAULT_BUDGET_BYTES", 0)
    node_journal.recover_node_journals(folder)
    notes = StreamNotes.load(folder / "journal" / "leg" / ("0" * 32))
    assert notes is not None
    assert notes.next_seq == 118
    with closing(
        Journal.open_existing_and_recover(folder / "journal" / "leg" / ("0" * 32))
    ) as found:
        assert found.stored == Intervals([(0, 117)])
    assert not list(folder.rglob("in_flight"))


def test_frames_in_flight_of_a_killed_acquisition_are_stored(
    journal: NodeJournal, stream: NodeStream
) -> None:
    """Its last batches never came through the pipe; the node itself lives on."""
    fill(journal, stream, 0, 89)
    take_in_flight(stream.folder, frames(0, 99))
    stream.mark_ended_in_memory()
    assert journal.wait_for_ended_streams_on_disk()
    assert stream.stored == Intervals([(0, 99)])
    assert (stream.next_seq, stream.lost.to_pairs()) == (100, {})


def test_damaged_frames_in_flight_are_set_aside_and_bounded(
    journal: NodeJournal, stream: NodeStream
) -> None:
    fill(journal, stream, 0, 89)
    take_in_flight(stream.folder, frames(0, 99))
    path = stream.folder / in_flight.IN_FLIGHT_FILE
    damaged = b"X" + path.read_bytes()[1:]
    path.write_bytes(damaged)
    stream.mark_ended_in_memory()
    assert journal.wait_for_ended_streams_on_disk()
    notes = StreamNotes.load(stream.folder)
    assert notes is not None
    assert (notes.next_seq, notes.max_lost_tail_frames) == (90, 0.5 * 500 + 17)
    assert path.with_name("in_flight.damaged-1").read_bytes() == damaged
    assert "in_flight.damaged-1" in " ".join(journal.problems)


def test_frames_in_flight_that_cannot_be_read_now_are_waited_for(
    journal: NodeJournal, stream: NodeStream, monkeypatch: pytest.MonkeyPatch
) -> None:
    fill(journal, stream, 0, 89)
    take_in_flight(stream.folder, frames(0, 99))
    with monkeypatch.context() as patched:
        refuse = refusing(StorageError, "cannot be read: Too many open files")
        patched.setattr(in_flight, "read_in_flight_of_this_boot", refuse)
        stream.mark_ended_in_memory()
        assert not journal.wait_for_ended_streams_on_disk(0.2)
    assert journal.wait_for_ended_streams_on_disk()
    assert stream.stored == Intervals([(0, 99)])


def test_a_stream_with_notes_of_a_later_version_is_left_out(start: Start, tmp_path: Path) -> None:
    journal = start()
    fill(journal, journal.switch_to_new_stream(make_array()), 0, 99)
    journal.end_streams_and_close()
    path = tmp_path / "journal" / "leg" / ("0" * 32) / "stream.json"
    said = json.loads(read_checksummed_json(path)) | {"clock_steps": 3}
    write_checksummed_json(path, json.dumps(said).encode())
    before = path.read_bytes()
    again = start()
    assert again.streams == []
    assert "by another version" in again.problems[0]
    assert "Update foottile" in again.problems[0]
    again.end_streams_and_close()
    assert [each.name for each in path.parent.glob("stream.json*")] == ["stream.json"]
    assert path.read_bytes() == before


@pytest.mark.parametrize("damaged", [0, 1, 2])
def test_streams_are_in_order_also_with_damaged_notes(
    start: Start, tmp_path: Path, damaged: int
) -> None:
    journal = start()
    names = ["f" * 32, "a" * 32, "c" * 32]
    for number, name in enumerate(names):
        stream = journal.switch_to_new_stream(make_array(stream_id=name))
        fill(journal, stream, 1000 * number, 1000 * number + 99)  # later by their instants
        until(lambda stream=stream: stream.stored.number_count == 100)  # type: ignore[misc]  # bound here
    journal.end_streams_and_close()
    (tmp_path / "journal" / "leg" / names[damaged] / "stream.json").write_bytes(b"{")
    again = start()
    assert [stream.stream_id for stream in again.streams] == names
    numbers = [stream.notes.number for stream in again.streams]
    assert numbers == sorted(set(numbers))
    assert "stream.json.damaged-1" in " ".join(again.problems)
