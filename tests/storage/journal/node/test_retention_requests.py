"""What sessions need: a server's word holds until it says something else."""

from __future__ import annotations

from pathlib import Path

import pytest

from storage.intervals import NO_END, Intervals
from storage.journal.node.retention_requests import RetentionRequest, RetentionRequests


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


DAMAGES = (b"", b"{", b"[]", b"null", b'{"servers": 7}', b"\xff", b"[" * 100_000, b"1e999")


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


def test_a_flipped_bit_is_noticed_wherever_it_is(tmp_path: Path) -> None:
    path = tmp_path / "retention.json"
    wanted = RetentionRequests(path)
    wanted.update_request_in_memory(
        "laptop", RetentionRequest(streams={"a": ((0, 9),)}, recording=True, known=("a",))
    )
    wanted.save()
    whole = path.read_bytes()
    for at in range(len(whole)):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 1 << at % 8]) + whole[at + 1 :])
        assert RetentionRequests(path).is_unknown
        path.with_name("retention.json.damaged-1").unlink()
