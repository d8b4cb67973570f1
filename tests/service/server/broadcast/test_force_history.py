"""The last minute of a node for a screen that is opened: nothing twice, nothing hidden, bounded."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from itertools import chain
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.server.broadcast.summary import (
    FORCE_SPAN_PERIOD_NS,
    SECONDS_MAX,
    ForceSpan,
    StreamHistory,
    nan_max,
    nan_min,
    reduce_tiles,
    summarize_force,
)
from tests.builders.arrays import PERIOD_NS
from tests.builders.frames import make_frames

ONE = "1" * 32
NAN = float("nan")
UNKNOWN = reduce_tiles({}, 2)


FORCES_N = np.random.default_rng(0).normal(50.0, 20.0, 50_000)
FORCES_N[::5] = NAN


def grf(first: int, n: int) -> np.ndarray:
    """Newtons that belong to these numbers; a fifth is not known."""
    return FORCES_N[first : first + n]


def span(first: int, n: int, *, period_ns: int = PERIOD_NS) -> ForceSpan:
    batch = make_frames(np.arange(first, first + n), period_ns=period_ns)
    return summarize_force(
        batch, {"grf_n": grf(first, n), "grf_lower_bound_n": np.arange(first, first + n)}
    )


def filled(runs: Sequence[tuple[int, int]], period_ns: int = PERIOD_NS) -> StreamHistory:
    """Runs of missing frames and frames."""
    recent, seq = StreamHistory(ONE, 2), 0
    for gap, n in runs:
        seq += gap
        recent.add_span(span(seq, n, period_ns=period_ns), UNKNOWN)
        seq += n
    return recent


def test_a_span_has_the_extremes_of_what_is_known_and_the_best_bound_of_what_is_not() -> None:
    columns = {
        "grf_n": np.array([3.0, NAN, 9.0, NAN, 4.0]),
        "grf_lower_bound_n": np.array([2.0, 60.0, 8.0, NAN, 3.0]),
    }
    made = summarize_force(make_frames(np.arange(10, 15)), columns)
    assert (made.seq_first, made.seq, made.n) == (10, 14, 5)
    assert made[5:] == (4.0, 3.0, 9.0, 60.0)


@pytest.mark.parametrize("columns", [{}, {"gauge_kpa": np.zeros((5, 2))}])
def test_without_estimates_there_are_frames_and_no_forces(columns: dict[str, np.ndarray]) -> None:
    made = summarize_force(make_frames(5), columns)
    assert made.n == 5
    assert np.isnan(made[5:]).all()


@pytest.mark.parametrize(("a", "b"), [(1.0, 2.0), (2.0, 1.0)])
def test_not_a_number_is_neither_smaller_nor_greater(a: float, b: float) -> None:
    assert (nan_min(a, b), nan_max(a, b)) == (1.0, 2.0)
    for pick in (nan_min, nan_max):
        assert pick(a, NAN) == pick(NAN, a) == a
        assert np.isnan(pick(NAN, NAN))


@settings(max_examples=60, deadline=None)
@given(
    st.lists(
        st.tuples(st.sampled_from([0, 0, 0, 1, 40]), st.integers(1, 60)), min_size=1, max_size=120
    )
)
def test_every_frame_is_in_one_span_with_its_force_between_least_and_greatest(
    runs: list[tuple[int, int]],
) -> None:
    rows = filled(runs).get_force_spans(SECONDS_MAX)
    sent = np.concatenate(
        [
            np.arange(at, at + n)
            for at, n in zip(
                np.cumsum([gap for gap, _ in runs]) + np.cumsum([0, *[n for _, n in runs]])[:-1],
                [n for _, n in runs],
                strict=True,
            )
        ]
    )
    assert rows["n"].sum() == len(sent)
    assert (rows["seq_first"][1:] > rows["seq"][:-1]).all()
    for row in rows:
        inside = sent[(sent >= row["seq_first"]) & (sent <= row["seq"])]
        assert len(inside) == row["n"]
        force_n = np.concatenate([grf(int(seq), 1) for seq in inside])
        for value, pick in ((row["grf_min_n"], np.fmin), (row["grf_max_n"], np.fmax)):
            np.testing.assert_equal(value, pick.reduce(force_n))
        unseen = inside[np.isnan(force_n)]
        np.testing.assert_equal(row["grf_lower_bound_max_n"], max(unseen, default=NAN))
        np.testing.assert_equal(row["grf_n"], force_n[-1])


@settings(max_examples=40, deadline=None)
@given(st.lists(st.integers(1, 30), min_size=2, max_size=200), st.data())
def test_what_is_told_next_goes_on_where_it_ends(sizes: list[int], data: st.DataObject) -> None:
    recent = filled([(0, n) for n in sizes])
    ends = np.cumsum([0, *sizes])
    told = data.draw(st.integers(max(0, len(sizes) - 30), len(sizes) - 1))  # of the last second
    rows = recent.get_force_spans(SECONDS_MAX, before_seq=int(ends[told]))
    if told:
        assert rows["seq"][-1] == ends[told] - 1
        assert rows["seq_first"][0] == 0
    assert (rows["seq_first"][1:] == rows["seq"][:-1] + 1).all()


def test_older_spans_are_joined_and_the_newest_are_as_they_were_told() -> None:
    recent = filled([(0, 1)] * 5000)
    rows = recent.get_force_spans(SECONDS_MAX)
    apart_ns = np.diff(rows["t_ns_first"])
    assert (rows["n"][-100:] == 1).all()
    assert (apart_ns[:-130] >= FORCE_SPAN_PERIOD_NS).all()
    assert (apart_ns[:-130] < FORCE_SPAN_PERIOD_NS + 2 * PERIOD_NS).all()


@pytest.mark.parametrize("seconds", [0.5, 5.0, 10.0, 60.0])
def test_so_many_seconds_are_given_as_were_asked_for(seconds: float) -> None:
    recent = filled([(0, 10)] * int(70e9 / (10 * PERIOD_NS)))
    rows = recent.get_force_spans(seconds)
    covered_s = (rows["t_ns"][-1] - rows["t_ns_first"][0]) * 1e-9
    assert seconds - 0.1 < covered_s < seconds + 0.1


def test_before_a_number_of_long_ago_no_frame_lacks() -> None:
    recent = filled([(0, 1)] * 5000)
    spans = recent.get_force_spans(SECONDS_MAX)
    joined = spans[spans["n"] > 1][-1]
    older = recent.get_force_spans(SECONDS_MAX, before_seq=int(joined["seq"]))
    assert older["seq"][-1] == joined["seq"]


def test_nothing_was_told_yet() -> None:
    assert (
        len(StreamHistory(ONE, 2).get_force_spans(SECONDS_MAX))
        == len(StreamHistory(ONE, 2).get_force_spans(1.0, before_seq=5))
        == 0
    )


@pytest.mark.parametrize(("frames", "gap"), [(10, 0), (1, 0), (1, 30)])
def test_a_node_costs_180_kb_however_long_it_streams(frames: int, gap: int) -> None:
    base = span(0, frames)
    recent, step = StreamHistory(ONE, 2), frames + gap
    for at in range(0, 32_000, step):
        t_ns = base.t_ns_first + at * PERIOD_NS
        times: dict[str, Any] = {"t_ns_first": t_ns, "t_ns": t_ns + (frames - 1) * PERIOD_NS}
        forces = dict.fromkeys(ForceSpan._fields[5:], float(at))
        recent.add_span(
            base._replace(seq_first=at, seq=at + frames - 1, **(times | forces)), UNKNOWN
        )
    kept = [recent._forces.rows, *recent._as_published, *chain(*recent._as_published)]
    assert len(recent.get_force_spans(SECONDS_MAX)) > 900
    assert 120_000 < sum(map(sys.getsizeof, kept)) < 180_000
