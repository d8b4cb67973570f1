"""What screens are told: the newest frame, the peaks of all that were skipped, and what was not."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from itertools import accumulate, pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.flags import CONTACT_UNKNOWN
from devices.frames import FrameBatch
from service.protocol.live import SessionProgress
from service.server.broadcast.summary import (
    SUMMARY_NS,
    FrameSummary,
    PendingUpdate,
    reduce_tiles,
    summarize_force,
    summarize_frames,
)
from tests.builders.arrays import PERIOD_NS
from tests.builders.frames import make_frames

TILES = 2

Columns = dict[str, np.ndarray]


def frames(first: int, rows: int, *, period_ns: int = PERIOD_NS) -> FrameBatch:
    seq = np.arange(first, first + rows)
    return make_frames(
        seq,
        period_ns=period_ns,
        servo_counts=0,
        tile_flags=seq[:, None] % 64 * [1, 0],
        frame_flags=seq % 32,
    )


def estimates(first: int, rows: int, *, silent: float = 0.2) -> Columns:
    """Estimates that belong to the numbers of the frames, some of them not known."""
    made = []
    for seq in range(first, first + rows):
        rng = np.random.default_rng(seq)
        force_n = rng.normal(0.0, 20.0, TILES)
        force_n[rng.random(TILES) < silent] = np.nan
        made.append((force_n, force_n / 7, force_n.sum()))
    force, gauge, grf = (np.array(column) for column in zip(*made, strict=True))
    return {
        "force_n": force,
        "gauge_kpa": gauge,
        "grf_n": grf,
        "contact": np.where(np.isnan(grf), CONTACT_UNKNOWN, grf > 0).astype(np.uint8),
        "estimate_flags": np.arange(first, first + rows, dtype=np.uint16),
    }


def summed_up(batch: FrameBatch, columns: Columns, stream_id: str = "0" * 32) -> FrameSummary:
    span, tiles = summarize_force(batch, columns), reduce_tiles(columns, batch.tile_count)
    return summarize_frames(stream_id, span, tiles, batch, columns)


def piece(
    first: int,
    rows: int,
    *,
    period_ns: int = PERIOD_NS,
    stream_id: str = "0" * 32,
    silent: float = 0.2,
) -> FrameSummary:
    columns = estimates(first, rows, silent=silent)
    batch = frames(first, rows, period_ns=period_ns)
    return summed_up(batch, columns, stream_id)


def taken(
    summary: PendingUpdate, ages_ms: Mapping[str, float] | None = None
) -> list[dict[str, Any]]:
    def refuse(constant: str) -> None:
        pytest.fail(f"{constant} is no JSON")

    texts = summary.pop_update().encode_messages(ages_ms or {})
    return [json.loads(text, parse_constant=refuse) for text in texts]


def progress(frames: int) -> SessionProgress:
    return SessionProgress(
        frames=frames,
        pending_frames=0,
        pending_reason=None,
        lost={},
        missed_slots=0,
        not_sampled_share=0.0,
        duration_s=0.0,
    )


def of_type(messages: Sequence[dict[str, Any]], kind: str) -> list[dict[str, Any]]:
    return [message for message in messages if message["type"] == kind]


def extremes(values: np.ndarray, digits: int) -> tuple[list[float | None], list[float | None]]:
    """Least and greatest by tile over what is known."""
    low, high = [], []
    for column in values.T:
        known = column[~np.isnan(column)].tolist()
        low.append(round(min(known), digits) if known else None)
        high.append(round(max(known), digits) if known else None)
    return low, high


# --- peaks ----------------------------------------------------------------------------------------


@settings(max_examples=50, deadline=None)
@given(st.lists(st.integers(1, 12), min_size=1, max_size=12), st.sampled_from([0.0, 0.3, 1.0]))
def test_minimum_and_maximum_of_all_that_was_skipped_go_with_the_newest(
    sizes: list[int], silent: float
) -> None:
    summary = PendingUpdate()
    for a, b in pairwise(accumulate(sizes, initial=0)):
        summary.join_summary_or_drop_older("bench", piece(a, b - a, silent=silent))
    total = sum(sizes)
    columns = estimates(0, total, silent=silent)
    (message,) = taken(summary)
    assert (message["type"], message["node"]) == ("frame", "bench")
    assert (message["seq"], message["n"]) == (total - 1, total)
    assert message["t_ns"] == 10**18 + (total - 1) * PERIOD_NS
    gauge, force = extremes(columns["gauge_kpa"], 4), extremes(columns["force_n"], 4)
    assert (message["gauge_min_kpa"], message["gauge_max_kpa"]) == gauge
    assert (message["force_min_n"], message["force_max_n"]) == force
    assert ([message["grf_min_n"]], [message["grf_max_n"]]) == extremes(
        columns["grf_n"][:, None], 4
    )
    newest = [None if np.isnan(v) else round(v, 4) for v in columns["force_n"][-1].tolist()]
    assert message["force_n"] == newest
    assert message["estimate_flags"] == total - 1
    assert taken(summary) == []


@given(st.lists(st.integers(1, 9), min_size=3, max_size=3))
def test_joining_pieces_is_summing_up_their_frames_and_in_any_grouping(sizes: list[int]) -> None:
    a, b, c, end = accumulate(sizes, initial=0)
    one, two, three = piece(a, b - a), piece(b, c - b), piece(c, end - c)
    whole = piece(0, end)
    for joined in (
        one.join_extremes(two).join_extremes(three),
        one.join_extremes(two.join_extremes(three)),
    ):
        np.testing.assert_array_equal(joined.span, whole.span)
        assert joined.newest == whole.newest
        np.testing.assert_array_equal(joined.tiles, whole.tiles)


# --- what is not told -----------------------------------------------------------------------------


@settings(max_examples=60, deadline=None)
@given(
    runs=st.lists(st.tuples(st.integers(0, 3), st.integers(1, 30)), min_size=1, max_size=25),
    takes=st.sets(st.integers(0, 24)),
    period_ns=st.sampled_from([PERIOD_NS, SUMMARY_NS // 40]),
)
def test_every_number_is_in_a_message_or_reported_as_dropped(
    runs: list[tuple[int, int]], takes: set[int], period_ns: int
) -> None:
    """Runs of lost frames and frames; a client that takes now and then."""
    summary, seq = PendingUpdate(), 0
    begin: int | None = None
    messages: list[dict[str, Any]] = []
    sent, lost = set[int](), set[int]()
    for at, (gap, rows) in enumerate(runs):
        lost |= set(range(seq, seq + gap)) if begin is not None else set()
        seq += gap
        begin = seq if begin is None else begin
        summary.join_summary_or_drop_older("bench", piece(seq, rows, period_ns=period_ns))
        sent |= set(range(seq, seq + rows))
        seq += rows
        if at in takes:
            messages += taken(summary)
    messages += taken(summary)
    told = sum(message["n"] for message in of_type(messages, "frame"))
    dropped = [
        n for m in of_type(messages, "dropped") for n in range(m["from_seq"], m["to_seq"] + 1)
    ]
    assert len(dropped) == len(set(dropped))
    assert lost <= set(dropped) <= lost | sent
    assert told == len(sent - set(dropped))
    assert len(of_type(messages, "frame") + of_type(messages, "dropped")) == len(messages)
    if period_ns == PERIOD_NS and sum(rows + gap for gap, rows in runs) < SUMMARY_NS // PERIOD_NS:
        assert set(dropped) == lost  # within a second nothing is dropped
    assert not {m["seq"] for m in of_type(messages, "frame")} & set(dropped)


def test_the_first_piece_says_nothing_of_what_was_before() -> None:
    summary = PendingUpdate()
    summary.join_summary_or_drop_older("bench", piece(1000, 10))
    assert [m["type"] for m in taken(summary)] == ["frame"]


def test_a_summary_is_of_a_second_at_most_and_older_frames_are_dropped() -> None:
    summary = PendingUpdate()
    for first in range(0, 2000, 10):  # 4 s
        summary.join_summary_or_drop_older("bench", piece(first, 10))
    messages = taken(summary)
    (frame,), (dropped,) = of_type(messages, "frame"), of_type(messages, "dropped")
    assert frame["n"] <= SUMMARY_NS // PERIOD_NS + 10
    assert (dropped["node"], dropped["from_seq"]) == ("bench", 0)
    assert dropped["to_seq"] == frame["seq"] - frame["n"]
    assert messages.index(dropped) < messages.index(frame)


def test_a_summary_is_of_a_second_at_most_although_frames_come_slower_than_they_should() -> None:
    summary, period_ns = PendingUpdate(), 10 * PERIOD_NS
    for first in range(0, 400, 5):  # 8 s
        summary.join_summary_or_drop_older("bench", piece(first, 5, period_ns=period_ns))
    (frame,) = of_type(taken(summary), "frame")
    assert (frame["n"] - 1) * period_ns <= SUMMARY_NS + 5 * period_ns


@pytest.mark.slow(parts=8)
@pytest.mark.parametrize("frames_sent", [1000, 20_000])
def test_a_client_that_never_takes_stays_bounded(frames_sent: int) -> None:
    """Of three frames two are lost, and there are notices: what is kept does not grow with time."""
    summary, period_ns = PendingUpdate(), 10_000_000
    one = vars(piece(0, 1))
    for at in range(0, 3 * frames_sent, 3):
        span = piece(0, 1).span._replace(seq_first=at, seq=at, t_ns=at * period_ns)
        summary.join_summary_or_drop_older("bench", FrameSummary(**one | {"span": span}))
        summary.add_notice('{"type":"node"}')
    messages = taken(summary)
    assert len(of_type(messages, "node")) == 256
    assert len(of_type(messages, "frame")) == 1
    # One interval for what was dropped, and the gaps of the present summary.
    assert len(of_type(messages, "dropped")) <= 1 + SUMMARY_NS // PERIOD_NS


def test_a_node_that_begins_anew_has_lost_nothing_by_that() -> None:
    summary = PendingUpdate()
    summary.join_summary_or_drop_older("bench", piece(100, 10))
    taken(summary)
    summary.join_summary_or_drop_older("bench", piece(0, 5, stream_id="1" * 32))
    summary.join_summary_or_drop_older("bench", piece(7, 5, stream_id="1" * 32))
    messages = taken(summary)
    assert [(m["from_seq"], m["to_seq"]) for m in of_type(messages, "dropped")] == [(5, 6)]
    assert [(m["seq"], m["n"]) for m in of_type(messages, "frame")] == [(11, 10)]


def test_frames_of_before_a_restart_that_were_not_told_are_dropped() -> None:
    summary = PendingUpdate()
    summary.join_summary_or_drop_older("bench", piece(100, 10))
    summary.join_summary_or_drop_older("bench", piece(0, 5, stream_id="1" * 32))
    messages = taken(summary)
    assert [(m["seq"], m["n"]) for m in of_type(messages, "frame")] == [(4, 5)]
    assert [(m["from_seq"], m["to_seq"]) for m in of_type(messages, "dropped")] == [(100, 109)]


# --- who is told what -----------------------------------------------------------------------------


def test_nodes_do_not_mix_and_one_may_look_at_one_only() -> None:
    everything, only = PendingUpdate(), PendingUpdate("right")
    for name, first in (("left", 0), ("right", 50), ("left", 10), ("right", 60)):
        for summary in (everything, only):
            summary.join_summary_or_drop_older(name, piece(first, 10))
    assert [(m["node"], m["seq"], m["n"]) for m in taken(everything)] == [
        ("left", 19, 20),
        ("right", 69, 20),
    ]
    assert [(m["node"], m["seq"]) for m in taken(only)] == [("right", 69)]


def test_there_is_something_to_tell_until_it_is_taken() -> None:
    summary = PendingUpdate("left")
    assert not summary
    summary.join_summary_or_drop_older("right", piece(0, 1))
    summary.add_progress("right", {"session": progress(1)})
    assert not summary
    changes: list[Callable[[], None]] = [
        lambda: summary.join_summary_or_drop_older("left", piece(0, 1)),
        lambda: summary.add_progress("left", {"session": progress(1)}),
        lambda: summary.add_notice('{"type":"notice"}'),
    ]
    for change in changes:
        change()
        assert summary
        assert len(taken(summary)) == 1
        assert not summary


def test_notices_come_first_in_their_order_and_the_oldest_are_forgotten() -> None:
    summary = PendingUpdate()
    summary.join_summary_or_drop_older("bench", piece(0, 1))
    for n in range(1000):
        summary.add_notice(json.dumps({"type": "notice", "n": n}))
    messages = taken(summary)
    assert messages[-1]["type"] == "frame"
    assert [m["n"] for m in messages[:-1]] == list(range(1000 - len(messages) + 1, 1000))
    assert len(messages) > 100


def test_a_session_is_not_told_as_smaller_after_it_is_told_as_sealed() -> None:
    summary = PendingUpdate()
    summary.add_progress("bench", {"session": progress(10)})
    summary.add_notice('{"type":"session"}')
    assert [m["type"] for m in taken(summary)] == ["session_progress", "session"]


@pytest.mark.parametrize(("age_ms", "told"), [(None, None), (0.0, 0.0), (12.34, 12.3)])
def test_the_age_goes_with_it_if_it_is_known(age_ms: float | None, told: float | None) -> None:
    summary = PendingUpdate()
    summary.join_summary_or_drop_older("bench", piece(0, 5))
    (message,) = taken(summary, {} if age_ms is None else {"bench": age_ms})
    assert message["age_ms"] == told


@settings(max_examples=60, deadline=None)
@given(
    runs=st.lists(st.tuples(st.integers(0, 3), st.integers(1, 30)), min_size=1, max_size=25),
    ticks=st.sets(st.integers(0, 24)),
    period_ns=st.sampled_from([PERIOD_NS, SUMMARY_NS // 40]),
)
def test_what_was_taken_and_not_told_is_told_later_as_if_it_had_not_been_taken(
    runs: list[tuple[int, int]], ticks: set[int], period_ns: int
) -> None:
    """One is told now and then; for the other what was taken at each tick is put together again."""
    told_once, feed, missed, seq = PendingUpdate(), PendingUpdate(), PendingUpdate(), 0
    for at, (gap, rows) in enumerate(runs):
        seq += gap if at else 0
        for summary in (told_once, feed):
            summary.join_summary_or_drop_older("bench", piece(seq, rows, period_ns=period_ns))
            summary.add_notice(json.dumps({"type": "notice", "n": at}))
            summary.add_progress("bench", {"session": progress(seq)})
        seq += rows
        if at in ticks:
            missed.add_update(feed.pop_update())
    missed.add_update(feed.pop_update())
    once, again = taken(told_once), taken(missed)
    assert told_or_dropped(once) == told_or_dropped(again) == seq
    if period_ns == PERIOD_NS and seq < SUMMARY_NS // PERIOD_NS:
        assert once == again  # within a second, so nothing is dropped


def told_or_dropped(messages: Sequence[dict[str, Any]]) -> int:
    """How many frames are told or reported as dropped, which no frame is twice."""
    dropped: set[int] = set()
    for message in of_type(messages, "dropped"):
        dropped |= set(range(message["from_seq"], message["to_seq"] + 1))
    told: list[int] = [message["n"] for message in of_type(messages, "frame")]
    return len(dropped) + sum(told)


# --- what is not known ----------------------------------------------------------------------------


def test_without_estimates_everything_estimated_is_null() -> None:
    summary = PendingUpdate()
    summary.join_summary_or_drop_older("bench", summed_up(frames(0, 5), {}))
    (message,) = taken(summary)
    for name in ("gauge_kpa", "force_n", "force_sigma_n", "gauge_min_kpa", "force_max_n"):
        assert message[name] == [None, None], name
    for name in ("grf_n", "grf_min_n", "grf_max_n", "cop_x_m", "angle_rad", "contact", "age_ms"):
        assert message[name] is None, name
    assert message["saturated"] == [False, False]
    assert message["estimate_flags"] == 0
    assert message["tile_flags"] == [4, 0]
    assert message["frame_flags"] == 4
    assert message["servo_age_us"] is None


def test_contact_and_saturation_are_those_of_the_newest_frame() -> None:
    columns = {
        "force_n": np.array([[50.0, 50.0], [10.0, 10.1]]),
        "force_sigma_n": np.array([[np.nan, np.nan], [0.1, np.nan]]),  # none of a lower bound
        "contact": np.array([CONTACT_UNKNOWN, 1], dtype=np.uint8),
    }
    newest = summed_up(frames(0, 2), columns).newest
    assert newest["saturated"] == [False, True]
    assert newest["contact"] is True
    for value, told in ((0, False), (CONTACT_UNKNOWN, None)):
        columns["contact"][-1] = value
        assert summed_up(frames(0, 2), columns).newest["contact"] is told
    columns["force_n"][-1] = np.nan
    assert summed_up(frames(0, 2), columns).newest["saturated"] == [False, False]
