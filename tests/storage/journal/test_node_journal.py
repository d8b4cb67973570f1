"""What a node keeps: everything, for as long as a session needs it, whatever the disk does."""

from __future__ import annotations

import errno
import os
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from devices.acquisition import FrameRow
from devices.errors import StorageError
from devices.frames import ArrayInfo, FrameBatch, TileStatus
from storage.intervals import NO_END, Intervals
from storage.journal import in_flight, node_journal, retention, segment
from storage.journal.in_flight import InFlight
from storage.journal.journal import Journal
from storage.journal.node_journal import NodeJournal
from storage.journal.node_stream import NodeStream
from storage.journal.stream_notes import StreamNotes
from storage.journal.wanted import ServerWants
from storage.wire import EncodedBatch

Arrays = Callable[..., ArrayInfo]
Batches = Callable[[int, int], EncodedBatch]
Start = Callable[..., NodeJournal]


def until(condition: Callable[[], object], timeout_s: float = 5.0) -> None:
    end_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.005)


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(node_journal, "SYNC_S", 0.02)
    monkeypatch.setattr(node_journal, "_TIDY_S", 0.02)
    monkeypatch.setattr(node_journal, "_AGAIN_S", 0.02)
    monkeypatch.setattr(retention, "_WEIGH_S", 0.02)


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """A node's journal that writes; ended with the test."""
    running: list[NodeJournal] = []

    def begin(**options: Any) -> NodeJournal:
        running.append(NodeJournal(tmp_path, "leg", **options))
        running[-1].start()
        return running[-1]

    yield begin
    for journal in running:
        journal.close()
    assert not any(thread.name == "journal" for thread in threading.enumerate())


@pytest.fixture
def fill(batch_of: Batches) -> Callable[..., None]:
    """Take frames `first` to `last`, ten in a batch."""

    def put(journal: NodeJournal, stream: NodeStream, first: int, last: int) -> None:
        for begin in range(first, last + 1, 10):
            journal.put(stream, batch_of(begin, min(begin + 9, last)))

    return put


Fill = Callable[[NodeJournal, NodeStream, int, int], None]


def on_disk(stream: NodeStream) -> Intervals:
    return stream.stored


def given(stream: NodeStream, first: int, last: int) -> list[int]:
    """First numbers of the batches that it gives for these frames."""
    return [batch.seq_first for batch in stream.batches(first, last)]


# --- always on ------------------------------------------------------------------------------------


def test_every_frame_is_on_disk_within_the_promise_and_can_be_given_at_any_time(
    start: Start, fill: Fill, array_of: Arrays
) -> None:
    journal = start()
    stream = journal.begin(array_of())
    fill(journal, stream, 0, 99)
    assert given(stream, 15, 44) == [10, 20, 30, 40]
    until(lambda: on_disk(stream) == Intervals([(0, 99)]))
    assert given(stream, 15, 44) == [10, 20, 30, 40]
    assert stream.held == Intervals([(0, 99)])
    assert journal.troubles == ()


def test_a_stream_that_ended_in_order_is_known_to_its_end_after_a_restart(
    start: Start, fill: Fill, array_of: Arrays
) -> None:
    journal = start()
    stream = journal.begin(array_of())
    fill(journal, stream, 0, 99)
    journal.close()
    again = start()
    (found,) = again.streams
    assert (found.next_seq, found.notes.unsynced_tail_max, found.is_settled) == (100, 0, True)
    assert found.held == Intervals([(0, 99)])
    assert again.begin(array_of(boot_id="1" * 32)).notes.number == found.notes.number + 1


def test_two_processes_do_not_use_one_nodes_folder(start: Start, tmp_path: Path) -> None:
    start()
    with pytest.raises(StorageError, match="another foottile process"):
        NodeJournal(tmp_path, "leg")
    NodeJournal(tmp_path, "arm").close()


def test_an_empty_stream_leaves_nothing(start: Start, array_of: Arrays) -> None:
    journal = start()
    stream = journal.begin(array_of())
    until(lambda: stream.journal is not None)
    journal.close()
    assert not stream.folder.exists()


# --- killed, and without power --------------------------------------------------------------------


def killed(journal: NodeJournal, folder: Path) -> Path:
    """The node's folder as SIGKILL leaves it: what the kernel has."""
    copy = folder.with_name(folder.name + "-killed")
    shutil.copytree(folder, copy)
    journal.close()
    return copy


def flying(stream: NodeStream, frames: FrameBatch) -> None:
    keeper = InFlight(stream.folder, stream.info)
    for i in range(len(frames)):
        keeper.put(FrameRow(*(getattr(frames, name)[i].tolist() for name in FrameRow._fields)))
    keeper.close()


def test_a_killed_node_has_lost_nothing(
    start: Start,
    fill: Fill,
    array_of: Arrays,
    frames_of: Callable[..., FrameBatch],
    tmp_path: Path,
) -> None:
    """What was in the pipe, or in a batch that was being filled, was in flight."""
    journal = start()
    stream = journal.begin(array_of())
    fill(journal, stream, 0, 99)
    until(lambda: on_disk(stream) == Intervals([(0, 99)]))
    frames = frames_of(0, 117)
    frames.padc[110] = 0  # out of range, which is flagged when a batch is whole
    flying(stream, frames)
    again = NodeJournal(killed(journal, tmp_path), "leg")
    again.start()
    (found,) = again.streams
    assert (found.next_seq, found.notes.unsynced_tail_max) == (118, 0)
    assert again.settle()
    assert on_disk(found) == Intervals([(0, 117)])
    assert found.journal is not None
    rescued = next(found.journal.read(110, 110))
    assert (rescued.status & TileStatus.OVER_RANGE).all()
    assert not (found.folder / "in_flight").exists()
    again.close()


def test_a_power_cut_costs_what_was_not_synced_and_says_how_much_that_may_be(
    start: Start,
    fill: Fill,
    array_of: Arrays,
    frames_of: Callable[..., FrameBatch],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    journal = start()
    stream = journal.begin(array_of())
    fill(journal, stream, 0, 99)
    until(lambda: on_disk(stream) == Intervals([(0, 99)]))
    flying(stream, frames_of(0, 117))
    folder = killed(journal, tmp_path)
    monkeypatch.setattr(in_flight, "kernel_boot_id", lambda: "another start of the machine")
    again = NodeJournal(folder, "leg")
    (found,) = again.streams
    assert found.next_seq == 100
    assert found.notes.unsynced_tail_max == 0.5 * 500 + 17
    again.close()


def test_a_disk_that_was_slower_than_the_promise_widens_the_bound(
    start: Start,
    fill: Fill,
    array_of: Arrays,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    journal = start()
    stream = journal.begin(array_of())
    real = os.fsync

    def slow(descriptor: int) -> None:
        time.sleep(0.6 if "arrows" in os.readlink(f"/proc/self/fd/{descriptor}") else 0.0)
        real(descriptor)

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", slow)
        fill(journal, stream, 0, 9)
        until(lambda: (n := StreamNotes.load(stream.folder)) and n.sync_max_s > 0.6)
    folder = killed(journal, tmp_path)
    again = NodeJournal(folder, "leg")
    assert again.streams[0].notes.unsynced_tail_max > 0.6 * 500
    again.close()


def test_killed_before_its_notes_were_written_a_stream_is_found_by_what_was_in_flight(
    start: Start, array_of: Arrays, frames_of: Callable[..., FrameBatch], tmp_path: Path
) -> None:
    keeper_of = NodeStream(
        tmp_path / "journal" / "leg" / ("2" * 32),
        StreamNotes(array_info=array_of(boot_id="2" * 32)),
        None,
    )
    flying(keeper_of, frames_of(0, 5))
    journal = start()
    (found,) = journal.streams
    assert (found.boot_id, found.next_seq) == ("2" * 32, 6)
    assert journal.settle()
    assert on_disk(found) == Intervals([(0, 5)])


# --- what is kept, and what is dropped ------------------------------------------------------------


def wants(*numbers: tuple[int, int | None]) -> ServerWants:
    return ServerWants(streams={"0" * 32: numbers}, known=("0" * 32,))


def test_the_ring_drops_what_no_session_needs_and_counts_what_no_server_has(
    start: Start, fill: Fill, array_of: Arrays, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(retention, "RING_NS", 200_000_000)
    monkeypatch.setattr("storage.journal.open_segments.SEGMENT_NS", 20_000_000)
    journal = start()
    stream = journal.begin(array_of())
    journal.want("laptop", wants((200, 249)))
    fill(journal, stream, 0, 599)
    stream.acknowledge("laptop", 100, 149)
    until(lambda: on_disk(stream).within(0, 489) == Intervals([(200, 249)]))
    assert stream.lost.by_reason == {"evicted": Intervals([(0, 99), (150, 199), (250, 489)])}
    stream.acknowledge("laptop", 200, 249)
    until(lambda: not on_disk(stream).within(0, 489))
    until(lambda: "evicted" in stream.notes.lost)


def test_over_its_budget_it_drops_the_ring_first_and_then_stops_and_counts(
    start: Start, fill: Fill, array_of: Arrays, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("storage.journal.open_segments.SEGMENT_NS", 20_000_000)
    monkeypatch.setattr(node_journal, "WAITING_BYTES", 20_000)
    journal = start(budget_bytes=60_000)
    stream = journal.begin(array_of())
    fill(journal, stream, 0, 99)
    until(lambda: not stream.waiting_bytes)
    journal.want("laptop", wants((100, None)))
    for first in range(100, 1000, 50):
        fill(journal, stream, first, first + 49)
        until(lambda: not stream.waiting_bytes or journal.troubles)
    assert "is full" in journal.troubles[0]
    fill(journal, stream, 1000, 1999)
    lost = stream.lost.by_reason
    assert lost["evicted"] == Intervals([(0, 99)])
    full = lost["disk_full"].count
    assert full > 500
    held = stream.held
    assert held.count + full + 100 == 2000
    # A server has taken some of them after all: there is room, and it goes on.
    stream.acknowledge("laptop", 100, 1999)
    fill(journal, stream, 2000, 2009)
    until(lambda: journal.troubles == () and on_disk(stream).last == 2009)
    assert "disk_full" not in stream.lost.as_pairs()


@pytest.mark.parametrize(
    ("number", "reason", "words"),
    [
        (errno.ENOSPC, "disk_full", "is full"),
        (errno.EROFS, "read_only", "Read-only file system"),
        (errno.EIO, "read_only", "Input/output error"),
    ],
)
def test_a_disk_that_takes_nothing_costs_what_memory_cannot_hold_and_goes_on_when_it_does(
    start: Start,
    fill: Fill,
    array_of: Arrays,
    monkeypatch: pytest.MonkeyPatch,
    number: int,
    reason: str,
    words: str,
) -> None:
    monkeypatch.setattr(node_journal, "WAITING_BYTES", 20_000)
    journal = start()
    stream = journal.begin(array_of())
    fill(journal, stream, 0, 49)
    until(lambda: on_disk(stream).last == 49 and stream.is_synced)

    def refuse(file: Any, data: bytes) -> None:
        raise OSError(number, os.strerror(number))

    with monkeypatch.context() as patch:
        patch.setattr(segment, "write_all", refuse)
        fill(journal, stream, 50, 69)
        until(lambda: journal.troubles)
        assert words in journal.troubles[0]
        fill(journal, stream, 70, 999)
        lost = stream.lost.by_reason[reason]
        assert next(iter(lost))[0] == 50
        assert stream.held.count + lost.count == 1000
        assert given(stream, 990, 999) == [990]  # the live picture, and what still waits
    until(lambda: journal.troubles == ())
    until(lambda: on_disk(stream).last == 999)
    assert on_disk(stream).count + stream.lost.by_reason[reason].count == 1000


def test_a_slow_disk_holds_up_nobody_and_what_does_not_fit_is_named(
    start: Start, fill: Fill, array_of: Arrays, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(node_journal, "WAITING_BYTES", 20_000)
    journal = start()
    stream = journal.begin(array_of())
    go_on = threading.Event()
    stuck = threading.Event()
    real = os.fsync

    def slow(descriptor: int) -> None:
        if "arrows" in os.readlink(f"/proc/self/fd/{descriptor}"):
            stuck.set()
            go_on.wait(10.0)
        real(descriptor)

    monkeypatch.setattr(os, "fsync", slow)
    fill(journal, stream, 0, 9)
    assert stuck.wait(5.0)
    fill(journal, stream, 10, 999)
    assert stream.lost.by_reason["disk_slow"].count > 500
    assert stream.recent(990)
    go_on.set()
    until(lambda: on_disk(stream).last == 999)
    assert on_disk(stream).count + stream.lost.all.count == 1000


def test_what_the_disk_could_not_sync_is_written_once_more(
    start: Start, fill: Fill, array_of: Arrays, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """After a failed fsync the kernel may have forgotten the pages, and says so only once."""
    journal = start()
    stream = journal.begin(array_of())
    fill(journal, stream, 0, 49)
    until(lambda: on_disk(stream).last == 49 and stream.is_synced)
    failures = 1
    real = os.fsync

    def fail(descriptor: int) -> None:
        nonlocal failures
        if failures and "arrows" in os.readlink(f"/proc/self/fd/{descriptor}"):
            failures -= 1
            raise OSError(errno.EIO, "Input/output error")
        real(descriptor)

    monkeypatch.setattr(os, "fsync", fail)
    fill(journal, stream, 50, 99)
    until(lambda: not failures and stream.is_synced)
    assert on_disk(stream) == Intervals([(0, 99)])
    names = sorted(path.name for path in stream.folder.glob("*.arrows"))
    assert len(names) >= 2


def test_frames_that_turn_out_damaged_are_named_and_given_no_more(
    start: Start, fill: Fill, array_of: Arrays
) -> None:
    journal = start()
    stream = journal.begin(array_of())
    fill(journal, stream, 0, 49)
    until(lambda: on_disk(stream).last == 49)
    journal.damaged(stream, Intervals([(20, 29)]))
    until(lambda: stream.lost.by_reason.get("corrupt") == Intervals([(20, 29)]))
    assert given(stream, 0, 49) == [0, 10, 30, 40]


def test_what_sessions_need_and_no_server_has_is_undelivered(
    start: Start, fill: Fill, array_of: Arrays
) -> None:
    journal = start()
    stream = journal.begin(array_of())
    journal.want("laptop", wants((50, None)))
    fill(journal, stream, 0, 99)
    assert journal.undelivered(stream) == Intervals([(50, 99)])
    stream.acknowledge("laptop", 0, 79)
    assert journal.undelivered(stream) == Intervals([(80, 99)])
    assert journal.wanted.numbers("0" * 32) == Intervals([(50, NO_END)])


def test_recovery_writes_what_was_in_flight_and_drops_nothing(
    start: Start,
    fill: Fill,
    array_of: Arrays,
    frames_of: Callable[..., FrameBatch],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    journal = start()
    stream = journal.begin(array_of())
    fill(journal, stream, 0, 99)
    until(lambda: on_disk(stream) == Intervals([(0, 99)]))
    flying(stream, frames_of(0, 117))
    folder = killed(journal, tmp_path)
    monkeypatch.setattr(retention, "RING_NS", 0)
    monkeypatch.setattr(node_journal, "BUDGET_BYTES", 0)
    node_journal.settle_left_over(folder)
    notes = StreamNotes.load(folder / "journal" / "leg" / ("0" * 32))
    assert notes is not None
    assert notes.next_seq == 118
    with closing(Journal.open(folder / "journal" / "leg" / ("0" * 32))) as found:
        assert found.held == Intervals([(0, 117)])
    assert not list(folder.rglob("in_flight"))


def test_what_the_nodes_own_session_needs_stays_whoever_has_it_besides(
    start: Start, fill: Fill, array_of: Arrays, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(retention, "RING_NS", 100_000_000)
    monkeypatch.setattr("storage.journal.open_segments.SEGMENT_NS", 20_000_000)
    journal = start()
    stream = journal.begin(array_of())
    journal.wanted.say_local({stream.boot_id: Intervals([(0, NO_END)])})
    fill(journal, stream, 0, 399)
    stream.acknowledge("laptop", 0, 399)
    until(lambda: on_disk(stream).last == 399)
    time.sleep(0.2)  # several looks
    assert on_disk(stream) == Intervals([(0, 399)])


def test_what_one_server_has_another_still_gets(
    start: Start, fill: Fill, array_of: Arrays, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(retention, "RING_NS", 100_000_000)
    monkeypatch.setattr("storage.journal.open_segments.SEGMENT_NS", 20_000_000)
    journal = start()
    stream = journal.begin(array_of())
    journal.want("laptop", wants((0, 199)))
    fill(journal, stream, 0, 399)
    until(lambda: on_disk(stream).last == 399)
    stream.acknowledge("other", 0, 399)
    until(lambda: not on_disk(stream).within(200, 299))
    assert on_disk(stream).within(0, 199) == Intervals([(0, 199)])
    assert journal.undelivered(stream) == Intervals([(0, 199)])


def test_what_acquisition_had_taken_when_it_was_killed_is_taken_over(
    start: Start, fill: Fill, array_of: Arrays, frames_of: Callable[..., FrameBatch]
) -> None:
    """Its last batches never came through the pipe; the node itself lives on."""
    journal = start()
    stream = journal.begin(array_of())
    fill(journal, stream, 0, 89)
    flying(stream, frames_of(0, 99))
    stream.end()
    assert journal.settle()
    assert on_disk(stream) == Intervals([(0, 99)])
    assert (stream.next_seq, stream.lost.as_pairs()) == (100, {})


def test_frames_that_were_not_handed_over_are_named(
    start: Start, fill: Fill, array_of: Arrays
) -> None:
    journal = start()
    stream = journal.begin(array_of())
    fill(journal, stream, 0, 9)
    fill(journal, stream, 30, 39)
    assert stream.lost.as_pairs() == {"node_busy": ((10, 29),)}


def test_the_bound_is_the_age_of_the_oldest_frame_when_it_is_on_the_disk(
    start: Start, fill: Fill, array_of: Arrays, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A frame that comes during one sync waits for that one and for the next."""
    journal = start()
    stream = journal.begin(array_of())
    real = os.fsync
    stuck = threading.Event()

    def slow(descriptor: int) -> None:
        if "arrows" in os.readlink(f"/proc/self/fd/{descriptor}"):
            stuck.set()
            time.sleep(0.35)
        real(descriptor)

    monkeypatch.setattr(os, "fsync", slow)
    fill(journal, stream, 0, 9)
    assert stuck.wait(5.0)
    fill(journal, stream, 10, 19)
    until(lambda: on_disk(stream).last == 19 and stream.is_synced)
    assert stream.notes.sync_max_s > 0.6


def test_over_the_bound_of_memory_the_oldest_goes_first_of_whichever_stream(
    start: Start, fill: Fill, array_of: Arrays, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A stream that ended while the disk took nothing does not leave the next one without room."""
    monkeypatch.setattr(node_journal, "WAITING_BYTES", 20_000)

    def refuse(file: Any, data: bytes) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(segment, "write_all", refuse)
    journal = start()
    before = journal.begin(array_of())
    fill(journal, before, 0, 149)
    until(lambda: journal.troubles)
    present = journal.begin(array_of(boot_id="1" * 32))
    fill(journal, present, 0, 99)
    assert present.held == Intervals([(0, 99)])
    assert "disk_full" in before.lost.as_pairs()
    fill(journal, present, 100, 499)
    assert not before.held
    assert present.held.last == 499
