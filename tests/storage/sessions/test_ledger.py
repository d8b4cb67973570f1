"""The ledger: whatever is known, every number is counted once."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from storage.intervals import NO_END, Intervals, Losses
from storage.sessions.folder import Part
from storage.sessions.ledger import StreamState, compute_ledger

pairs = st.lists(
    st.tuples(st.integers(0, 60), st.integers(0, 20)).map(lambda p: (p[0], p[0] + p[1])), max_size=5
)


@given(
    first=st.integers(0, 40),
    length=st.integers(0, 40),
    held=pairs,
    full=pairs,
    evicted=pairs,
    may_come=pairs,
)
def test_recorded_and_lost_and_pending_are_all_there_is(
    first: int,
    length: int,
    held: list[tuple[int, int]],
    full: list[tuple[int, int]],
    evicted: list[tuple[int, int]],
    may_come: list[tuple[int, int]],
) -> None:
    stream = StreamState(
        stored=Intervals(held),
        lost=Losses({"disk_full": full, "evicted": evicted}),
        obtainable=Intervals(may_come),
    )
    part = Part(stream_id="a", seq_first=first, seq_last=first + length - 1)
    counted = compute_ledger((part,), {"a": stream}, is_finished=True)
    (one,) = counted.parts
    assert one.recorded + sum(one.lost.values()) + one.pending == length
    assert one.recorded == Intervals(held).restricted_to(first, first + length - 1).number_count
    assert counted.complete == (one.recorded == length)
    assert counted.lossy == bool(one.lost)


def test_a_part_without_an_end_reaches_to_what_is_held_and_is_not_complete() -> None:
    stream = StreamState(stored=Intervals([(5, 9)]), obtainable=Intervals([(0, NO_END)]))
    counted = compute_ledger((Part(stream_id="a", seq_first=3),), {"a": stream}, is_finished=True)
    assert counted.parts[0].seq_last == 9
    assert (counted.parts[0].recorded, counted.parts[0].pending) == (5, 2)
    assert not counted.complete
    assert not counted.lossy


def test_what_the_node_came_back_without_is_named() -> None:
    counted = compute_ledger((Part(stream_id="a", seq_first=0, seq_last=9),), {}, is_finished=True)
    assert counted.parts[0].lost == {"node_restarted": 10}
    assert counted.lossy


def test_an_open_tail_is_no_loss_that_is_counted_but_the_session_is_not_complete() -> None:
    stream = StreamState(stored=Intervals([(0, 9)]), max_lost_tail_frames=280)
    part = Part(stream_id="a", seq_first=0, seq_last=9)
    counted = compute_ledger((part,), {"a": stream}, is_finished=True)
    assert counted.parts[0].lost == {}
    assert counted.parts[0].max_lost_tail_frames == 280
    assert counted.lossy
    assert not counted.complete
