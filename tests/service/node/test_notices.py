"""What becomes wrong with an array is said once, and once that it is over."""

from __future__ import annotations

from service.node.notices import Notices

SILENT = {"T02": "tile T02 does not answer"}


def test_what_lasts_is_said_once() -> None:
    notices = Notices()
    assert notices.since({}) == ()
    assert notices.since(SILENT) == ()
    assert notices.since(SILENT) == ("tile T02 does not answer",)
    assert notices.since(SILENT) == ()


def test_what_comes_and_goes_is_not_said() -> None:
    notices = Notices()
    for _ in range(5):
        assert notices.since(SILENT) == ()
        assert notices.since({}) == ()


def test_that_it_is_over_is_said_once_and_only_if_it_lasts() -> None:
    notices = Notices()
    notices.since(SILENT)
    notices.since(SILENT)
    assert notices.since({}) == ()
    assert notices.since(SILENT) == (), "a moment of sense is no recovery"
    assert notices.since({}) == ()
    assert notices.since({}) == ("no longer: tile T02 does not answer",)
    assert notices.since({}) == ()


def test_what_turns_into_something_worse_is_said_again() -> None:
    notices = Notices()
    notices.since(SILENT)
    notices.since(SILENT)
    worse = {"T02": "another part answers in place of tile T02"}
    assert notices.since(worse) == ()
    assert notices.since(worse) == ("another part answers in place of tile T02",)


def test_each_tile_is_told_of_by_itself() -> None:
    notices = Notices()
    both = {**SILENT, "": "the bus is stuck or cut"}
    notices.since(both)
    assert set(notices.since(both)) == set(both.values())
    notices.since(SILENT)
    assert notices.since(SILENT) == ("no longer: the bus is stuck or cut",)
