"""Frames out of order are seen, in whatever pieces they come."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.errors import FileFormatError
from devices.frames import FrameBatch
from storage.intervals import Intervals
from storage.sessions.ledger import FrameOrderChecker, iterate_checking_order
from tests.builders.frames import make_frames


def columns(seq: list[int], part: list[int] | None = None) -> dict[str, Any]:
    numbers = np.array(seq, dtype=np.uint64)
    found = {"seq": numbers, "t_mono_ns": 10 * numbers.astype(np.int64)}
    found |= {"t_ns": found["t_mono_ns"] + 7}
    return found if part is None else found | {"part": np.array(part, dtype=np.uint16)}


def looked_at(content: dict[str, Any], cuts: list[int]) -> FrameOrderChecker:
    order = FrameOrderChecker()
    bounds = [0, *sorted(cuts), len(content["seq"])]
    for begin, end in itertools.pairwise(bounds):
        order.add_and_check_frames({name: values[begin:end] for name, values in content.items()})
    return order


@given(
    st.lists(st.sets(st.integers(0, 40), min_size=1), min_size=1, max_size=3),
    st.lists(st.integers(0, 20), max_size=3),
)
def test_what_is_there_is_counted_however_it_comes(parts: list[set[int]], cuts: list[int]) -> None:
    seq = [n for numbers in parts for n in sorted(numbers)]
    part = [i for i, numbers in enumerate(parts) for _ in numbers]
    order = looked_at(columns(seq, part), [min(cut, len(seq)) for cut in cuts])
    assert order.problems == []
    for found, numbers in zip(order.parts, parts, strict=True):
        assert found.frames == found.numbers.number_count == len(numbers)
        assert found.numbers == Intervals((n, n) for n in numbers)
        assert (found.seq_first, found.seq_last) == (min(numbers), max(numbers))
        assert found.gaps.number_count == max(numbers) - min(numbers) + 1 - len(numbers)
        assert found.offset_ns == 7


@pytest.mark.parametrize("cut", [[], [1], [2], [3]])
@pytest.mark.parametrize(
    ("name", "values", "said"),
    [
        ("seq", [0, 1, 1, 2], "frame 1 follows frame 1"),
        ("seq", [0, 2, 1, 3], "frame 1 follows frame 2"),
        ("seq", [5, 2**64 - 1, 0, 1], "frame 0 follows"),
        ("t_mono_ns", [0, 10, 9, 30], "time runs back by 1 ns before frame 2"),
        ("t_ns", [7, 17, 28, 37], "t_ns of frame 2"),
        ("part", [1, 1, 0, 0], "part 0 follows part 1"),
    ],
)
def test_what_is_out_of_order_is_named(
    cut: list[int], name: str, values: list[int], said: str
) -> None:
    content = columns([0, 1, 2, 3], [0, 0, 0, 0])
    content[name] = np.array(values, dtype=content[name].dtype)
    if name == "t_mono_ns":
        content["t_ns"] = content[name] + 7
    assert said in "; ".join(looked_at(content, cut).problems)


def test_of_a_thousand_disorders_a_few_are_named_and_all_counted() -> None:
    order = looked_at(columns([0] * 1000), [])
    assert len(order.problems) == 4
    assert "996 more" in order.problems[-1]


def batch(seq: list[int]) -> FrameBatch:
    return make_frames(seq, 1)


def test_who_relies_on_order_is_given_frames_up_to_the_first_disorder() -> None:
    given_out = []
    pieces: list[tuple[FrameBatch, dict[str, np.ndarray]]]
    pieces = [(batch([0, 1]), {}), (batch([2, 3]), {}), (batch([3, 4]), {})]
    ordered = iterate_checking_order(pieces, where="walk.parquet")
    given_out += [int(next(ordered)[0].seq[0]) for _ in range(2)]
    with pytest.raises(FileFormatError, match=r"walk\.parquet.*out of order.*frame 3 follows"):
        next(ordered)
    assert given_out == [0, 2]
