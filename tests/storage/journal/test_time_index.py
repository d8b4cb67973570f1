"""What a message has to fit between is known from the messages before, without reading a file."""

from __future__ import annotations

from itertools import accumulate, pairwise
from random import Random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from storage.intervals import Intervals
from storage.journal.time_index import TimeIndex
from storage.wire import EncodedBatch
from tests.builders.arrays import PERIOD_NS
from tests.builders.frames import make_frames, with_columns


@given(st.lists(st.integers(1, 4), min_size=1, max_size=12), st.randoms(use_true_random=False))
def test_messages_of_any_size_in_any_order_are_judged_without_a_look_at_the_disk(
    sizes: list[int], random: Random
) -> None:
    stored = Intervals()
    instants = TimeIndex(lambda seq, is_upper: pytest.fail(f"{seq} was looked up"))
    spans = list(pairwise(accumulate(sizes, initial=0)))
    random.shuffle(spans)
    for begin, end in spans:
        frames = make_frames(np.arange(begin, end))
        before, after = stored.nearest_outside(begin, end - 1)
        assert instants.describe_reversal_against_stored(frames, stored) == ""
        for neighbour, side in ((before, -1), (after, 1)):
            if neighbour is not None:
                leap_ns = (neighbour - begin + side * len(spans) * 5) * PERIOD_NS
                moved = with_columns(frames, t_ns=frames.t_ns + leap_ns)
                assert "time runs back" in instants.describe_reversal_against_stored(moved, stored)
        stored.add(begin, end - 1)
        instants.register_message(EncodedBatch.from_frames_and_payload(frames, b""), stored)


def test_when_something_is_not_held_any_more_the_disk_is_asked_once() -> None:
    asked: list[tuple[int, bool]] = []

    def look_up(seq: int, is_upper: bool) -> int:
        asked.append((seq, is_upper))
        return int(make_frames([seq]).t_ns[0])

    instants, stored = TimeIndex(look_up), Intervals([(0, 9)])
    instants.register_message(EncodedBatch.from_frames_and_payload(make_frames(10), b""), stored)
    instants.forget_cached_times()
    for _ in range(3):
        assert (
            instants.describe_reversal_against_stored(make_frames(np.arange(10, 12)), stored) == ""
        )
    assert asked == [(9, True)]
