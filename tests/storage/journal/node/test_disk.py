"""A disk that is full, slow or failing: what that costs, and that it is named."""

from __future__ import annotations

import errno
import os
import threading
import time
from pathlib import Path

import pytest

from storage.intervals import Intervals
from storage.journal import segment_writer
from storage.journal.journal import Journal
from storage.journal.node import journal as node_journal
from storage.journal.node.journal import NodeJournal
from storage.journal.node.stream import NodeStream
from tests.builders.arrays import make_array
from tests.storage.faulty_disk import (
    IO_ERROR,
    NO_SPACE,
    before_each_sync_of_frames,
    failing_once,
    refusing,
)
from tests.storage.journal.node.leg import Start, fill, given, store
from tests.waiting import until


@pytest.mark.parametrize(
    ("number", "reason", "words"),
    [
        (errno.ENOSPC, "disk_full", "is full"),
        (errno.EROFS, "read_only", "Read-only file system"),
        (errno.EIO, "read_only", "Input/output error"),
    ],
)
def test_a_failing_disk_costs_what_memory_cannot_store(
    journal: NodeJournal,
    stream: NodeStream,
    monkeypatch: pytest.MonkeyPatch,
    number: int,
    reason: str,
    words: str,
) -> None:
    monkeypatch.setattr(node_journal, "MAX_WAITING_BYTES", 20_000)
    fill(journal, stream, 0, 49)
    until(lambda: stream.stored.last == 49 and stream.is_synced)

    with monkeypatch.context() as patch:
        patch.setattr(
            segment_writer, "write_all_or_none", refusing(OSError, number, os.strerror(number))
        )
        fill(journal, stream, 50, 69)
        until(lambda: journal.disk_refusal_warnings)
        assert words in journal.disk_refusal_warnings[0]
        fill(journal, stream, 70, 999)
        lost = stream.lost.by_reason[reason]
        assert next(iter(lost))[0] == 50
        assert stream.available.number_count + lost.number_count == 1000
        assert given(stream, 990, 999) == [990]  # the live picture, and what still waits
    until(lambda: journal.disk_refusal_warnings == ())
    until(lambda: stream.stored.last == 999)
    assert stream.stored.number_count + stream.lost.by_reason[reason].number_count == 1000


def test_a_slow_disk_blocks_nobody_and_losses_are_named(
    journal: NodeJournal, stream: NodeStream, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(node_journal, "MAX_WAITING_BYTES", 20_000)
    go_on = threading.Event()
    stuck = threading.Event()

    def slow() -> None:
        stuck.set()
        go_on.wait(10.0)

    before_each_sync_of_frames(monkeypatch, slow)
    fill(journal, stream, 0, 9)
    assert stuck.wait(5.0)
    fill(journal, stream, 10, 999)
    assert stream.lost.by_reason["disk_slow"].number_count > 500
    assert stream.recent_batches(990)
    go_on.set()
    until(lambda: stream.stored.last == 999)
    assert stream.stored.number_count + stream.lost.numbers.number_count == 1000


def test_batches_of_a_failed_sync_are_written_again(
    journal: NodeJournal, stream: NodeStream, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """After a failed fsync the kernel may have forgotten the pages, and says so only once."""
    fill(journal, stream, 0, 49)
    until(lambda: stream.stored.last == 49 and stream.is_synced)
    tried: list[bool] = []
    before_each_sync_of_frames(monkeypatch, failing_once(lambda: tried.append(True), *IO_ERROR))
    fill(journal, stream, 50, 99)
    until(lambda: tried and stream.is_synced)
    assert stream.stored == Intervals([(0, 99)])
    names = sorted(path.name for path in stream.folder.glob("*.arrows"))
    assert len(names) >= 2


def test_frames_of_a_failed_sync_can_be_read_all_the_while(
    journal: NodeJournal, stream: NodeStream, monkeypatch: pytest.MonkeyPatch
) -> None:
    disown = Journal.invalidate_batches_wholly_within
    seen: list[tuple[Intervals, list[int]]] = []

    def then_looked_at(journal_: Journal, numbers: Intervals) -> None:
        disown(journal_, numbers)
        seen.append((stream.available, given(stream, 0, 49)))

    monkeypatch.setattr(Journal, "invalidate_batches_wholly_within", then_looked_at)
    before_each_sync_of_frames(monkeypatch, failing_once(lambda: None, *IO_ERROR))
    fill(journal, stream, 0, 49)
    until(lambda: seen and stream.available.last == 49 and stream.is_synced)
    held, batches = seen[0]
    assert (held.first, held.number_count) == (0, 10 * len(batches))
    assert batches == list(range(0, held.number_count, 10))
    assert batches


def test_damaged_frames_are_named_and_not_given(journal: NodeJournal, stream: NodeStream) -> None:
    store(journal, stream, 0, 49)
    journal.queue_invalidation(stream, Intervals([(20, 29)]))
    until(lambda: stream.lost.by_reason.get("corrupt") == Intervals([(20, 29)]))
    assert given(stream, 0, 49) == [0, 10, 30, 40]


def test_the_bound_is_the_age_of_the_oldest_frame_at_its_sync(
    journal: NodeJournal, stream: NodeStream, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A frame that comes during one sync waits for that one and for the next."""
    stuck = threading.Event()

    def slow() -> None:
        stuck.set()
        time.sleep(0.35)

    before_each_sync_of_frames(monkeypatch, slow)
    fill(journal, stream, 0, 9)
    assert stuck.wait(5.0)
    fill(journal, stream, 10, 19)
    until(lambda: stream.stored.last == 19 and stream.is_synced)
    assert stream.notes.sync_max_s > 0.6


def test_over_the_bound_of_memory_the_oldest_frames_of_all_go(
    start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A stream that ended while the disk took nothing does not leave the next one without room."""
    monkeypatch.setattr(node_journal, "MAX_WAITING_BYTES", 20_000)

    monkeypatch.setattr(segment_writer, "write_all_or_none", refusing(*NO_SPACE))
    journal = start()
    before = journal.switch_to_new_stream(make_array())
    fill(journal, before, 0, 149)
    until(lambda: journal.disk_refusal_warnings)
    present = journal.switch_to_new_stream(make_array(stream_id="1" * 32))
    fill(journal, present, 0, 99)
    assert present.available == Intervals([(0, 99)])
    assert "disk_full" in before.lost.to_pairs()
    fill(journal, present, 100, 499)
    assert not before.available
    assert present.available.last == 499
