"""What sessions need: a server's word holds until it says something else."""

from __future__ import annotations

from pathlib import Path

import pytest

from devices.errors import FileFormatError
from storage.intervals import NO_END, Intervals
from storage.journal.wanted import ServerWants, Wanted


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


def test_a_damaged_file_is_an_error_that_says_what_to_do(tmp_path: Path) -> None:
    (tmp_path / "wanted.json").write_text("{")
    with pytest.raises(FileFormatError, match="Move it away"):
        Wanted(tmp_path / "wanted.json")
