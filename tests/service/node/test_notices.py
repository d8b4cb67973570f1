"""What becomes wrong with an array is said once, and once that it is over."""

from __future__ import annotations

from service.node.news import News

SILENT = {"T02": "tile T02 does not answer"}


def test_what_lasts_is_said_once() -> None:
    news = News()
    assert news.since({}) == ()
    assert news.since(SILENT) == ()
    assert news.since(SILENT) == ("tile T02 does not answer",)
    assert news.since(SILENT) == ()


def test_what_comes_and_goes_is_not_said() -> None:
    news = News()
    for _ in range(5):
        assert news.since(SILENT) == ()
        assert news.since({}) == ()


def test_that_it_is_over_is_said_once_and_only_if_it_lasts() -> None:
    news = News()
    news.since(SILENT)
    news.since(SILENT)
    assert news.since({}) == ()
    assert news.since(SILENT) == (), "a moment of sense is no recovery"
    assert news.since({}) == ()
    assert news.since({}) == ("no longer: tile T02 does not answer",)
    assert news.since({}) == ()


def test_what_turns_into_something_worse_is_said_again() -> None:
    news = News()
    news.since(SILENT)
    news.since(SILENT)
    worse = {"T02": "another part answers in place of tile T02"}
    assert news.since(worse) == ()
    assert news.since(worse) == ("another part answers in place of tile T02",)


def test_each_tile_is_told_of_by_itself() -> None:
    news = News()
    both = {**SILENT, "": "the bus is stuck or cut"}
    news.since(both)
    assert set(news.since(both)) == set(both.values())
    news.since(SILENT)
    assert news.since(SILENT) == ("no longer: the bus is stuck or cut",)
