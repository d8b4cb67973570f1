"""What a node keeps: everything, for as long as a session needs it."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from devices.errors import StorageError
from storage.documents import append_json_checksum
from storage.intervals import NO_END, Intervals
from storage.journal.node import journal as node_journal
from storage.journal.node import retention
from storage.journal.node.journal import NodeJournal
from storage.journal.node.retention import RetentionRequest, RetentionRequests
from storage.journal.node.stream import NodeStream
from tests.builders.arrays import make_array
from tests.storage.journal.node.leg import Start, fill, given, store
from tests.waiting import until


def test_every_frame_is_stored_soon_and_can_be_read_at_any_time(
    journal: NodeJournal, stream: NodeStream
) -> None:
    fill(journal, stream, 0, 99)
    assert given(stream, 15, 44) == [10, 20, 30, 40]
    until(lambda: stream.stored == Intervals([(0, 99)]))
    assert given(stream, 15, 44) == [10, 20, 30, 40]
    assert stream.available == Intervals([(0, 99)])
    assert journal.disk_refusal_warnings == ()


def test_two_processes_do_not_use_one_nodes_folder(start: Start, tmp_path: Path) -> None:
    start()
    with pytest.raises(StorageError, match="another foottile process"):
        NodeJournal(tmp_path, "leg")
    NodeJournal(tmp_path, "arm").end_streams_and_close()


def test_an_empty_stream_leaves_nothing(journal: NodeJournal, stream: NodeStream) -> None:
    until(lambda: stream.journal is not None)
    journal.end_streams_and_close()
    assert not stream.folder.exists()


def wants(*numbers: tuple[int, int | None]) -> RetentionRequest:
    return RetentionRequest(streams={"0" * 32: numbers}, known=("0" * 32,))


def test_the_ring_drops_what_no_session_needs(
    journal: NodeJournal, stream: NodeStream, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(retention, "RING_DURATION_NS", 200_000_000)
    monkeypatch.setattr("storage.journal.segment_writer.SEGMENT_DURATION_NS", 20_000_000)
    journal.update_retention_request("laptop", wants((200, 249)))
    fill(journal, stream, 0, 599)
    stream.record_acknowledgement("laptop", 100, 149)
    evicted = Intervals([(0, 99), (150, 199), (250, 489)])
    until(lambda: stream.lost.by_reason == {"evicted": evicted})
    assert stream.stored.restricted_to(0, 489) == Intervals([(200, 249)])
    stream.record_acknowledgement("laptop", 200, 249)
    until(lambda: not stream.stored.restricted_to(0, 489))
    until(lambda: "evicted" in stream.notes.lost)


def test_with_damaged_requests_only_the_budget_drops_frames(
    start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(retention, "RING_DURATION_NS", 200_000_000)
    monkeypatch.setattr(node_journal, "_CLEANUP_INTERVAL_S", 0.0)
    monkeypatch.setattr("storage.journal.segment_writer.SEGMENT_DURATION_NS", 20_000_000)
    folder = tmp_path / "journal" / "leg"
    folder.mkdir(parents=True)
    (folder / "retention.json").write_bytes(b"damaged")
    journal = start(budget_bytes=60_000)
    assert "retention.json.damaged-1" in " ".join(journal.problems)
    stream = journal.switch_to_new_stream(make_array())
    store(journal, stream, 0, 299)
    time.sleep(2 * node_journal.SYNC_INTERVAL_S)  # for several looks at what is old
    assert stream.stored == Intervals([(0, 299)])
    monkeypatch.setattr(retention, "_BUDGET_CHECK_INTERVAL_S", 0.0)
    store(journal, stream, 300, 1499)
    until(lambda: stream.stored.first != 0)
    assert stream.stored.last == 1499
    assert journal.disk_refusal_warnings == ()


def test_over_the_budget_the_ring_goes_first_then_frames_are_lost(
    start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("storage.journal.segment_writer.SEGMENT_DURATION_NS", 20_000_000)
    monkeypatch.setattr(node_journal, "MAX_WAITING_BYTES", 20_000)
    journal = start(budget_bytes=60_000)
    stream = journal.switch_to_new_stream(make_array())
    fill(journal, stream, 0, 99)
    until(lambda: not stream.unwritten_bytes)
    journal.update_retention_request("laptop", wants((100, None)))
    for first in range(100, 1000, 50):
        fill(journal, stream, first, first + 49)
        until(lambda: not stream.unwritten_bytes or journal.disk_refusal_warnings)
    assert "is full" in journal.disk_refusal_warnings[0]
    fill(journal, stream, 1000, 1999)
    lost = stream.lost.by_reason
    assert lost["evicted"] == Intervals([(0, 99)])
    full = lost["disk_full"].number_count
    assert full > 500
    held = stream.available
    assert held.number_count + full + 100 == 2000
    # A server has taken some of them after all: there is room, and it goes on.
    stream.record_acknowledgement("laptop", 100, 1999)
    fill(journal, stream, 2000, 2009)
    until(lambda: journal.disk_refusal_warnings == () and stream.stored.last == 2009)
    assert "disk_full" not in stream.lost.to_pairs()


def test_required_frames_of_no_server_are_undelivered(
    journal: NodeJournal, stream: NodeStream
) -> None:
    journal.update_retention_request("laptop", wants((50, None)))
    fill(journal, stream, 0, 99)
    assert journal.available_undelivered_numbers(stream) == Intervals([(50, 99)])
    stream.record_acknowledgement("laptop", 0, 79)
    assert journal.available_undelivered_numbers(stream) == Intervals([(80, 99)])
    assert journal.retention_requests.node_session_or_server_numbers_of("0" * 32) == Intervals(
        [(50, NO_END)]
    )


def test_frames_of_the_nodes_own_session_stay(
    journal: NodeJournal, stream: NodeStream, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(retention, "RING_DURATION_NS", 100_000_000)
    monkeypatch.setattr("storage.journal.segment_writer.SEGMENT_DURATION_NS", 20_000_000)
    journal.retention_requests.set_node_session_numbers(
        {stream.stream_id: Intervals([(0, NO_END)])}
    )
    fill(journal, stream, 0, 399)
    stream.record_acknowledgement("laptop", 0, 399)
    until(lambda: stream.stored.last == 399)
    time.sleep(0.2)  # several looks
    assert stream.stored == Intervals([(0, 399)])


def test_what_one_server_has_another_still_gets(
    journal: NodeJournal, stream: NodeStream, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(retention, "RING_DURATION_NS", 100_000_000)
    monkeypatch.setattr("storage.journal.segment_writer.SEGMENT_DURATION_NS", 20_000_000)
    journal.update_retention_request("laptop", wants((0, 199)))
    store(journal, stream, 0, 399)
    stream.record_acknowledgement("other", 0, 399)
    until(lambda: not stream.stored.restricted_to(200, 299))
    assert stream.stored.restricted_to(0, 199) == Intervals([(0, 199)])
    assert journal.available_undelivered_numbers(stream) == Intervals([(0, 199)])


def test_frames_not_handed_over_are_named(journal: NodeJournal, stream: NodeStream) -> None:
    fill(journal, stream, 0, 9)
    fill(journal, stream, 30, 39)
    assert stream.lost.to_pairs() == {"node_busy": ((10, 29),)}


def test_a_request_outlives_the_process(tmp_path: Path) -> None:
    wanted = RetentionRequests(tmp_path / "retention.json")
    assert wanted.update_request_in_memory(
        "laptop", RetentionRequest(streams={"a": ((5, 9), (20, None))})
    )
    assert not wanted.update_request_in_memory(
        "laptop", RetentionRequest(streams={"a": ((5, 9), (20, None))})
    )
    wanted.save()
    again = RetentionRequests(tmp_path / "retention.json")
    assert again.node_session_or_server_numbers_of("a") == Intervals([(5, 9), (20, NO_END)])
    assert again.node_session_or_server_numbers_of("b") == Intervals()


def test_an_unknown_stream_is_required_while_a_session_is_recorded(tmp_path: Path) -> None:
    wanted = RetentionRequests(tmp_path / "retention.json")
    wanted.update_request_in_memory(
        "laptop", RetentionRequest(streams={"b": ((7, None),)}, recording=True, known=("a", "b"))
    )
    assert wanted.node_session_or_server_numbers_of("c") == Intervals([(0, NO_END)])
    assert wanted.node_session_or_server_numbers_of("b") == Intervals([(7, NO_END)])
    assert wanted.node_session_or_server_numbers_of("a") == Intervals()


def test_one_server_does_not_give_up_what_another_needs(tmp_path: Path) -> None:
    wanted = RetentionRequests(tmp_path / "retention.json")
    wanted.update_request_in_memory("laptop", RetentionRequest(streams={"a": ((0, 9),)}))
    wanted.update_request_in_memory("other", RetentionRequest(streams={"a": ((5, 14),)}))
    wanted.set_node_session_numbers({"a": Intervals([(100, 109)])})
    assert wanted.node_session_or_server_numbers_of("a") == Intervals([(0, 14), (100, 109)])
    wanted.update_request_in_memory("laptop", RetentionRequest())
    assert wanted.node_session_or_server_numbers_of("a") == Intervals([(5, 14), (100, 109)])


DAMAGES = (b"", b"[" * 100_000, append_json_checksum(b'{"servers": 7}'))


@pytest.mark.parametrize("content", DAMAGES, ids=lambda c: repr(c[:12]))
def test_while_a_damaged_file_is_there_all_frames_may_be_required(
    tmp_path: Path, content: bytes
) -> None:
    path = tmp_path / "retention.json"
    path.write_bytes(content)
    wanted = RetentionRequests(path)
    assert wanted.is_unknown
    assert "retention.json.damaged-1" in " ".join(wanted.problems)
    assert path.with_name("retention.json.damaged-1").read_bytes() == content
    wanted.update_request_in_memory("laptop", RetentionRequest(streams={"a": ((0, 9),)}))
    wanted.save()
    again = RetentionRequests(path)
    assert again.node_session_or_server_numbers_of("a") == Intervals([(0, 9)])
    assert again.is_unknown
    assert "Delete" in again.problems[0]
    path.with_name("retention.json.damaged-1").unlink()
    assert not RetentionRequests(path).is_unknown
    assert RetentionRequests(path).problems == []
