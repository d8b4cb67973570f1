"""Intervals are a set of numbers: whatever a Python set says of them, they say."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from storage.intervals import Intervals

TOP = 40

numbers = st.integers(0, TOP)
pairs = st.lists(st.tuples(numbers, numbers).map(lambda ends: (min(ends), max(ends))), max_size=12)


def members(intervals: Iterable[tuple[int, int]]) -> set[int]:
    return {n for first, last in intervals for n in range(first, last + 1)}


def assert_tidy(intervals: Intervals) -> None:
    """Sorted, and neither touching nor overlapping."""
    assert all(first <= last for first, last in intervals)
    assert all(one[1] + 1 < other[0] for one, other in pairwise(intervals))


@given(pairs)
def test_it_holds_what_was_added_in_whatever_order(added: list[tuple[int, int]]) -> None:
    found = Intervals()
    for at, (first, last) in enumerate(added):
        found.add(first, last)
        assert_tidy(found)
        assert members(found) == members(added[: at + 1])
    assert found.number_count == len(members(added))
    assert found.last == max(members(added), default=None)
    assert bool(found) == bool(added)
    assert found == Intervals(reversed(added))


@given(pairs, numbers, numbers)
def test_within_missing_and_without_are_those_of_sets(
    added: list[tuple[int, int]], first: int, last: int
) -> None:
    stored, asked = Intervals(added), set(range(first, last + 1))
    within, missing = stored.restricted_to(first, last), stored.missing_in(first, last)
    assert members(within) == members(added) & asked
    assert members(missing) == asked - members(added)
    assert_tidy(within)
    assert_tidy(missing)
    assert members(stored) == members(added)  # asking changes nothing


@given(pairs, pairs)
def test_union_intersection_and_difference_are_those_of_sets(
    added: list[tuple[int, int]], other: list[tuple[int, int]]
) -> None:
    a, b = Intervals(added), Intervals(other)
    for made, expected in (
        (a | b, members(a) | members(b)),
        (a & b, members(a) & members(b)),
        (a - b, members(a) - members(b)),
    ):
        assert members(made) == expected
        assert_tidy(made)


@given(pairs, pairs)
def test_two_are_equal_when_they_hold_the_same_numbers(
    one: list[tuple[int, int]], other: list[tuple[int, int]]
) -> None:
    assert (Intervals(one) == Intervals(other)) == (members(one) == members(other))


def test_numbers_may_be_as_large_as_a_stream_can_count() -> None:
    stored = Intervals([(0, 0), (2**62, 2**64)])
    assert list(stored.missing_in(0, 2**64)) == [(1, 2**62 - 1)]
    assert stored.number_count == 2**64 - 2**62 + 2


def test_an_empty_interval_is_refused_and_changes_nothing() -> None:
    stored = Intervals([(3, 5)])
    with pytest.raises(ValueError, match="5 to 4 is empty"):
        stored.add(5, 4)
    assert list(stored) == [(3, 5)]


def test_it_is_no_key_of_a_dictionary_and_no_list_is_equal_to_it() -> None:
    with pytest.raises(TypeError, match="unhashable"):
        hash(Intervals())
    assert Intervals([(1, 2)]) != [(1, 2)]
    assert repr(Intervals([(1, 2), (3, 3)])) == "Intervals([(1, 3)])"
