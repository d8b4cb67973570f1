"""What becomes wrong with an array is said once, and once that it is over."""

from __future__ import annotations

from service.node.acquisition_process import WarningDebouncer

SILENT = {"T02": "tile T02 does not answer"}


def test_what_lasts_is_said_once() -> None:
    notices = WarningDebouncer()
    assert notices.update({}) == ()
    assert notices.update(SILENT) == ()
    assert notices.update(SILENT) == ("tile T02 does not answer",)
    assert notices.update(SILENT) == ()


def test_what_comes_and_goes_is_not_said() -> None:
    notices = WarningDebouncer()
    for _ in range(5):
        assert notices.update(SILENT) == ()
        assert notices.update({}) == ()


def test_that_it_is_over_is_said_once_and_only_if_it_lasts() -> None:
    notices = WarningDebouncer()
    notices.update(SILENT)
    notices.update(SILENT)
    assert notices.update({}) == ()
    assert notices.update(SILENT) == (), "a moment of sense is no recovery"
    assert notices.update({}) == ()
    assert notices.update({}) == ("no longer: tile T02 does not answer",)
    assert notices.update({}) == ()


def test_what_turns_into_something_worse_is_said_again() -> None:
    notices = WarningDebouncer()
    notices.update(SILENT)
    notices.update(SILENT)
    worse = {"T02": "another part answers in place of tile T02"}
    assert notices.update(worse) == ()
    assert notices.update(worse) == ("another part answers in place of tile T02",)


def test_each_tile_is_told_of_by_itself() -> None:
    notices = WarningDebouncer()
    both = {**SILENT, "": "the bus is stuck or cut"}
    notices.update(both)
    assert set(notices.update(both)) == set(both.values())
    notices.update(SILENT)
    assert notices.update(SILENT) == ("no longer: the bus is stuck or cut",)
