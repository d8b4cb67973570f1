"""The backlog: what is most urgent first, nothing twice, nothing forgotten."""

from __future__ import annotations

import threading
from collections.abc import Callable

from hypothesis import given
from hypothesis import strategies as st

from service.node.frame_sender import Backlog
from storage.intervals import Intervals
from tests.waiting import until

pairs = st.lists(
    st.tuples(st.integers(0, 60), st.integers(0, 20)).map(lambda p: (p[0], p[0] + p[1])), max_size=4
)


def sent(backlog: Backlog, frames_max: int) -> list[tuple[str, int, int]]:
    """Everything it gives, in order, until there is no more."""
    found = []
    while (wanted := backlog.get_next_range(frames_max)) is not None:
        found.append(wanted)
        backlog.remove_frames(*wanted)
    return found


@given(
    lacks=st.lists(st.tuples(st.sampled_from("ab"), pairs), max_size=4),
    frames_max=st.integers(1, 30),
)
def test_everything_that_lacks_is_given_once_in_pieces(
    lacks: list[tuple[str, list[tuple[int, int]]]], frames_max: int
) -> None:
    backlog = Backlog((stream_id, Intervals(numbers)) for stream_id, numbers in lacks)
    expected = {
        stream_id: Intervals(pair for b, numbers in lacks if b == stream_id for pair in numbers)
        for stream_id in "ab"
    }
    assert backlog.frame_count == sum(numbers.number_count for numbers in expected.values())
    given_ = {"a": Intervals(), "b": Intervals()}
    total = 0
    for stream_id, first, last in sent(backlog, frames_max):
        assert 0 < last - first + 1 <= frames_max
        given_[stream_id].add(first, last)
        total += last - first + 1
    assert given_ == expected
    assert total == sum(numbers.number_count for numbers in expected.values())
    assert backlog.frame_count == 0


def test_the_first_range_of_the_list_goes_first() -> None:
    """A server names what sessions need before what is only for pre-roll."""
    backlog = Backlog([("a", Intervals([(50, 59)])), ("b", Intervals([(0, 4)]))])
    backlog.add_frames("a", 0, 9)
    assert sent(backlog, 100) == [("a", 0, 9), ("a", 50, 59), ("b", 0, 4)]


def test_a_stream_that_nobody_lacked_anything_of_can_fall_behind() -> None:
    backlog = Backlog()
    assert backlog.get_next_range(10) is None
    backlog.add_frames("a", 5, 9)
    assert backlog.get_next_range(3) == ("a", 5, 7)


class Meanwhile(Intervals):
    """Numbers that are overtaken by the loop just when a thread takes some off."""

    overtake: Callable[[], None]

    def __sub__(self, other: Intervals) -> Intervals:
        left = super().__sub__(other)
        adding = threading.Thread(target=Meanwhile.overtake)
        adding.start()
        adding.join(0.2)  # it may have to wait until that is done
        return left


def test_frames_added_while_a_thread_removes_others_are_not_forgotten() -> None:
    backlog = Backlog([("a", Meanwhile([(0, 5)]))])
    Meanwhile.overtake = staticmethod(lambda: backlog.add_frames("a", 8, 9))
    backlog.remove_frames("a", 0, 3)
    until(lambda: backlog.frame_count == 4)
    assert sent(backlog, 10) == [("a", 4, 5), ("a", 8, 9)]
