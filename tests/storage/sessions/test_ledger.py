"""The ledger counts each number once, and frames out of order are named."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.errors import FileFormatError
from devices.frames import FrameBatch
from storage.intervals import NO_END, Intervals, Losses
from storage.sessions.folder import Part
from storage.sessions.ledger import (
    FrameOrderChecker,
    StreamState,
    compute_ledger,
    iterate_checking_order,
)
from tests.builders.frames import make_frames

pairs = st.lists(
    st.tuples(st.integers(0, 60), st.integers(0, 20)).map(lambda p: (p[0], p[0] + p[1])), max_size=5
)


@given(
    first=st.integers(0, 40),
    length=st.integers(0, 40),
    stored=pairs,
    full=pairs,
    evicted=pairs,
    may_come=pairs,
)
def test_recorded_and_lost_and_pending_are_all_there_is(
    first: int,
    length: int,
    stored: list[tuple[int, int]],
    full: list[tuple[int, int]],
    evicted: list[tuple[int, int]],
    may_come: list[tuple[int, int]],
) -> None:
    stream = StreamState(
        stored=Intervals(stored),
        lost=Losses({"disk_full": full, "evicted": evicted}),
        obtainable=Intervals(may_come),
    )
    part = Part(stream_id="a", seq_first=first, seq_last=first + length - 1)
    counted = compute_ledger((part,), {"a": stream}, has_all_parts=True)
    (one,) = counted.parts
    assert one.recorded + sum(one.lost.values()) + one.pending == length
    assert one.recorded == Intervals(stored).restricted_to(first, first + length - 1).number_count
    assert counted.complete == (one.recorded == length)
    assert counted.lossy == bool(one.lost)


def test_a_part_without_an_end_is_not_complete() -> None:
    stream = StreamState(stored=Intervals([(5, 9)]), obtainable=Intervals([(0, NO_END)]))
    counted = compute_ledger((Part(stream_id="a", seq_first=3),), {"a": stream}, has_all_parts=True)
    assert counted.parts[0].seq_last == 9
    assert (counted.parts[0].recorded, counted.parts[0].pending) == (5, 2)
    assert not counted.complete
    assert not counted.lossy


def test_what_the_node_came_back_without_is_named() -> None:
    counted = compute_ledger(
        (Part(stream_id="a", seq_first=0, seq_last=9),), {}, has_all_parts=True
    )
    assert counted.parts[0].lost == {"node_restarted": 10}
    assert counted.lossy


def test_an_open_tail_is_no_counted_loss_and_not_complete() -> None:
    stream = StreamState(stored=Intervals([(0, 9)]), max_lost_tail_frames=280)
    part = Part(stream_id="a", seq_first=0, seq_last=9)
    counted = compute_ledger((part,), {"a": stream}, has_all_parts=True)
    assert counted.parts[0].lost == {}
    assert counted.parts[0].max_lost_tail_frames == 280
    assert counted.lossy
    assert not counted.complete


# --- order ----------------------------------------------------------------------------------------


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
def test_frames_are_counted_in_any_pieces(parts: list[set[int]], cuts: list[int]) -> None:
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
def test_disorder_is_named(cut: list[int], name: str, values: list[int], said: str) -> None:
    content = columns([0, 1, 2, 3], [0, 0, 0, 0])
    content[name] = np.array(values, dtype=content[name].dtype)
    if name == "t_mono_ns":
        content["t_ns"] = content[name] + 7
    assert said in "; ".join(looked_at(content, cut).problems)


def test_of_many_disorders_a_few_are_named_and_all_counted() -> None:
    order = looked_at(columns([0] * 1000), [])
    assert len(order.problems) == 4
    assert "996 more" in order.problems[-1]


def test_frames_are_given_up_to_the_first_disorder() -> None:
    pieces: list[tuple[FrameBatch, dict[str, Any]]]
    pieces = [(make_frames(seq, 1), {}) for seq in ([0, 1], [2, 3], [3, 4])]
    ordered = iterate_checking_order(pieces, where="walk.parquet")
    given_out = [int(next(ordered)[0].seq[0]) for _ in range(2)]
    with pytest.raises(FileFormatError, match=r"walk\.parquet.*out of order.*frame 3 follows"):
        next(ordered)
    assert given_out == [0, 2]
