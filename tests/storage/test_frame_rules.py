"""What frames keep to, and that server and `verify` ask the same."""

from __future__ import annotations

from contextlib import closing
from itertools import accumulate, pairwise
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.frames import NO_SERVO_AGE, NO_SERVO_COUNTS, NOT_READ, FrameBatch
from storage.frame_rules import describe_first_broken_rule
from storage.intervals import Intervals
from storage.journal.journal import Journal
from storage.journal.time_index import TimeIndex
from storage.verify.journal import verify_journal
from storage.wire import EncodedBatch
from tests.builders.arrays import PERIOD_NS, UTC_NS, make_array
from tests.builders.frames import make_frames, with_columns

INFO = make_array(2)


def test_ordinary_frames_and_the_ends_of_every_range_keep_to_the_rules() -> None:
    batch = make_frames(
        4,
        pressure_raw=[[0], [1023], [NOT_READ], [500]],
        temperature_raw=[[NOT_READ], [0], [1023], [480]],
        tile_flags=[[0], [63], [1], [32]],
        frame_flags=[0, 31, 1, 16],
        sample_offset_us=[[0], [60_000_000], [-60_000_000], [1]],
        servo_counts=[NO_SERVO_COUNTS, 2**31 - 1, -5, 0],
        servo_age_us=[NO_SERVO_AGE, 0, 2**31 - 1, 1],
        reference_force_n=[np.nan, -1e6, 1e6, 0.0],
    )
    assert describe_first_broken_rule(batch, INFO) == ""


@pytest.mark.parametrize(
    ("column", "wrong", "said"),
    [
        ("pressure_raw", 1024, "more than the chip can give"),
        ("temperature_raw", 65534, "more than the chip can give"),
        ("tile_flags", 64, "tile_flags has undefined bits"),
        ("frame_flags", 64, "frame_flags has undefined bits"),
        ("sample_offset_us", 60_000_001, "a minute"),
        ("sample_offset_us", -(2**31), "a minute"),
        ("servo_age_us", -2, "negative"),
        ("reference_force_n", np.inf, "no force"),
        ("reference_force_n", -2e6, "no force"),
        ("t_ns", UTC_NS, "plus the"),
        ("t_mono_ns", 2**60, "36 years"),
        ("t_mono_ns", 2**63 - 1, "36 years"),
        ("t_mono_ns", -(2**63), "36 years"),
        ("t_mono_ns", -UTC_NS - 1, "1970"),
    ],
)
def test_an_impossible_value_is_named_with_its_frame(column: str, wrong: Any, said: str) -> None:
    batch = make_frames(5)
    values = getattr(batch, column).copy()
    values[3] = wrong
    found = describe_first_broken_rule(with_columns(batch, **{column: values}), INFO)
    assert said in found
    assert "in frame 3" in found


def test_an_offset_that_fits_only_because_it_wraps_is_seen() -> None:
    batch = make_frames(3)
    t_mono_ns = np.full(3, 2**63 - 1)
    t_ns = np.full(3, (2**63 - 1 + UTC_NS) % 2**64 - 2**64)
    assert (t_ns - t_mono_ns == UTC_NS).all()
    wrapped = FrameBatch(**{**vars(batch), "t_mono_ns": t_mono_ns, "t_ns": t_ns})
    assert "36 years" in describe_first_broken_rule(wrapped, INFO)


@settings(max_examples=60)
@given(data=st.data())
def test_messages_taken_in_any_order_are_whole_for_verify(
    data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Messages in any order with any instants: those that a server takes, `verify` finds whole."""
    folder = tmp_path_factory.mktemp("data") / "journal" / "bench" / INFO.stream_id
    drawn = st.tuples(
        st.integers(0, 30), st.integers(1, 6), st.sampled_from([0, 0, 0, -9_000_000, 9_000_000])
    )
    taken = 0
    messages = data.draw(st.lists(drawn, min_size=1, max_size=8))
    with closing(Journal(folder, INFO)) as journal:
        for first, rows, late_ns in messages:
            batch = make_frames(np.arange(first, first + rows))
            batch = with_columns(batch, t_mono_ns=batch.t_mono_ns + late_ns)
            if not describe_first_broken_rule(
                batch, INFO
            ) and not journal.describe_reversal_against_stored(batch):
                taken += journal.append_new_frames(batch).number_count
    if taken:
        report = verify_journal(folder)
        assert report.problems == []
        assert report.stored.number_count == taken


def test_what_does_not_fit_between_its_neighbours_is_misplaced(tmp_path: Path) -> None:
    journal = Journal(tmp_path, INFO)
    frames = make_frames(30)
    journal.append_new_frames(frames.slice_rows(0, 10))
    journal.append_new_frames(frames.slice_rows(20, 30))
    between = frames.slice_rows(10, 20)
    assert journal.describe_reversal_against_stored(between) == ""
    late = with_columns(between, t_mono_ns=between.t_mono_ns + 20_000_000)
    early = with_columns(between, t_mono_ns=between.t_mono_ns - 20_000_000)
    assert journal.describe_reversal_against_stored(late) == "time runs back before frame 20"
    assert journal.describe_reversal_against_stored(early) == "time runs back before frame 10"
    assert (
        Journal(tmp_path, INFO).describe_reversal_against_stored(late)
        == "time runs back before frame 20"
    )
    journal.close()


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
