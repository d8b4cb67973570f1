"""What sessions need: a server's word holds until it says something else."""

from __future__ import annotations

from pathlib import Path

import pytest

from storage.intervals import NO_END, Intervals
from storage.journal.node.wanted import ServerWants, Wanted


def test_a_servers_word_outlives_the_process(tmp_path: Path) -> None:
    wanted = Wanted(tmp_path / "wanted.json")
    assert wanted.say("laptop", ServerWants(streams={"a": ((5, 9), (20, None))}))
    assert not wanted.say("laptop", ServerWants(streams={"a": ((5, 9), (20, None))}))
    wanted.save()
    again = Wanted(tmp_path / "wanted.json")
    assert again.numbers("a") == Intervals([(5, 9), (20, NO_END)])
    assert again.numbers("b") == Intervals()


def test_while_a_session_is_recorded_a_stream_nobody_has_heard_of_belongs_to_it(
    tmp_path: Path,
) -> None:
    wanted = Wanted(tmp_path / "wanted.json")
    wanted.say("laptop", ServerWants(streams={"b": ((7, None),)}, recording=True, known=("a", "b")))
    assert wanted.numbers("c") == Intervals([(0, NO_END)])
    assert wanted.numbers("b") == Intervals([(7, NO_END)])
    assert wanted.numbers("a") == Intervals()


def test_one_server_does_not_give_up_what_another_needs(tmp_path: Path) -> None:
    wanted = Wanted(tmp_path / "wanted.json")
    wanted.say("laptop", ServerWants(streams={"a": ((0, 9),)}))
    wanted.say("other", ServerWants(streams={"a": ((5, 14),)}))
    wanted.say_local({"a": Intervals([(100, 109)])})
    assert wanted.numbers("a") == Intervals([(0, 14), (100, 109)])
    wanted.say("laptop", ServerWants())
    assert wanted.numbers("a") == Intervals([(5, 14), (100, 109)])


DAMAGES = (b"", b"{", b"[]", b"null", b'{"servers": 7}', b"\xff", b"[" * 100_000, b"1e999")


@pytest.mark.parametrize("content", DAMAGES, ids=lambda c: repr(c[:12]))
def test_a_damaged_file_is_set_aside_and_as_long_as_it_is_there_all_may_be_wanted(
    tmp_path: Path, content: bytes
) -> None:
    path = tmp_path / "wanted.json"
    path.write_bytes(content)
    wanted = Wanted(path)
    assert wanted.may_be_all
    assert "wanted.json.damaged-1" in " ".join(wanted.problems)
    assert path.with_name("wanted.json.damaged-1").read_bytes() == content
    wanted.say("laptop", ServerWants(streams={"a": ((0, 9),)}))
    wanted.save()
    again = Wanted(path)
    assert again.numbers("a") == Intervals([(0, 9)])
    assert again.may_be_all
    assert "Delete" in again.problems[0]
    path.with_name("wanted.json.damaged-1").unlink()
    assert not Wanted(path).may_be_all
    assert Wanted(path).problems == []


def test_a_flipped_bit_is_noticed_wherever_it_is(tmp_path: Path) -> None:
    path = tmp_path / "wanted.json"
    wanted = Wanted(path)
    wanted.say("laptop", ServerWants(streams={"a": ((0, 9),)}, recording=True, known=("a",)))
    wanted.save()
    whole = path.read_bytes()
    for at in range(len(whole)):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 1 << at % 8]) + whole[at + 1 :])
        assert Wanted(path).may_be_all
        path.with_name("wanted.json.damaged-1").unlink()


def test_a_file_of_an_older_version_is_read_and_called_unproven(tmp_path: Path) -> None:
    path = tmp_path / "wanted.json"
    path.write_text('{"servers":{"laptop":{"streams":{"a":[[0,9]]}}}}')
    wanted = Wanted(path)
    assert wanted.numbers("a") == Intervals([(0, 9)])
    assert not wanted.is_proven
    wanted.save()
    assert Wanted(path).is_proven
