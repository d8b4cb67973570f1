"""One time axis for parts whose node had other dates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from storage.clock.bounds import OffsetRows
from storage.clock.table import ClockTable, StreamClockFacts
from storage.sessions.time_axis import MAX_GAP_NS, NODE_AXIS, PartSpan, TimeAxis, compute_time_axis

SECOND = 1_000_000_000
PERIOD_NS = 2_000_000
SERVER_NS = 1_767_225_600 * SECOND
YEARS_57 = 57 * 365 * 86_400 * SECOND
BOUND_NS = 1_000_000


@dataclass(frozen=True)
class Part:
    """A part as it truly was: its length, the time before it, its node's date, what is known.

    Attributes:
        gap_ns: between the part before and this one.
        length_ns: from its first frame to its last.
        wrong_ns: what its node's date is behind the server's.
        is_measured: was its clock compared?
    """

    gap_ns: int
    length_ns: int
    wrong_ns: int
    is_measured: bool


def spans_and_clock(parts: list[Part]) -> tuple[list[PartSpan], ClockTable, list[int]]:
    """What files say of these parts, and when each truly began, after the first one's begin."""
    spans, rows, begins_ns, now_ns = [], {}, [], 0
    for number, part in enumerate(parts):
        now_ns += part.gap_ns if number else 0
        begins_ns.append(now_ns)
        name, t_mono_ns = f"stream-{number}", 50 * SECOND
        t_ns = SERVER_NS + now_ns - part.wrong_ns
        ends = (t_mono_ns, t_mono_ns + part.length_ns), (t_ns, t_ns + part.length_ns)
        spans.append(PartSpan(number, name, *ends))
        if part.is_measured:
            rows[name] = OffsetRows(
                *np.array([[t_mono_ns], [part.wrong_ns], [BOUND_NS]], dtype=np.int64)
            )
        now_ns += part.length_ns
    names = [span.stream_id for span in spans]
    return spans, ClockTable(rows, [StreamClockFacts(name) for name in names], names), begins_ns


def found(parts: list[Part]) -> tuple[TimeAxis, list[int], list[int]]:
    """The axis, where on it each part begins, and where it truly does."""
    spans, clock, begins_ns = spans_and_clock(parts)
    axis = compute_time_axis(spans, clock, period_ns=PERIOD_NS)
    first_ns = spans[0].t_ns[0]
    on_axis = [span.t_ns[0] + axis.get_shift_ns(span.number) - first_ns for span in spans]
    return axis, on_axis, begins_ns


WRONG = st.sampled_from(
    [0, SECOND, 3600 * SECOND, YEARS_57, -3600 * SECOND, -20 * 365 * 86_400 * SECOND]
)
PARTS = st.lists(
    st.builds(
        Part,
        gap_ns=st.integers(PERIOD_NS, 3600 * SECOND),
        length_ns=st.integers(0, 3600 * SECOND),
        wrong_ns=WRONG,
        is_measured=st.booleans(),
    ),
    min_size=1,
    max_size=5,
)


@given(PARTS)
def test_parts_follow_each_other_whatever_dates_their_node_had(parts: list[Part]) -> None:
    axis, on_axis, _ = found(parts)
    assert axis.get_shift_ns(0) == 0
    for i in range(1, len(parts)):
        gap_ns = on_axis[i] - on_axis[i - 1] - parts[i - 1].length_ns
        assert 0 < gap_ns <= MAX_GAP_NS


@given(PARTS)
def test_what_was_measured_is_where_it_was_within_the_bound(parts: list[Part]) -> None:
    measured = [Part(p.gap_ns, p.length_ns, p.wrong_ns, is_measured=True) for p in parts]
    axis, on_axis, truly = found(measured)
    assert "joined" not in axis.bases
    # Each of the two clocks' bounds, and how far crystals drift over the length of a part.
    for i in range(1, len(parts)):
        steps_ns = on_axis[i] - on_axis[i - 1], truly[i] - truly[i - 1]
        assert abs(steps_ns[0] - steps_ns[1]) <= 2 * BOUND_NS + 1e-3 * parts[i - 1].length_ns + 10


@given(PARTS)
def test_a_right_date_is_left_as_it_is(parts: list[Part]) -> None:
    axis, _, _ = found([Part(p.gap_ns, p.length_ns, 0, p.is_measured) for p in parts])
    assert not axis.is_shifted
    assert set(axis.bases) == {"node"}


@pytest.mark.parametrize("wrong_ns", [YEARS_57, -YEARS_57 // 2])
@pytest.mark.parametrize("measured", [(False, False), (True, False), (False, True)])
def test_parts_of_unmeasured_clocks_are_joined(wrong_ns: int, measured: tuple[bool, bool]) -> None:
    parts = [
        Part(0, SECOND, wrong_ns, is_measured=measured[0]),
        Part(5 * SECOND, SECOND, 0, is_measured=measured[1]),
    ]
    axis, on_axis, _ = found(parts)
    assert axis.bases == ("node", "joined")
    assert on_axis[1] == SECOND + PERIOD_NS
    assert "not compared" in axis.explain_shift_or_empty()


def test_a_step_of_the_servers_date_shifts_no_part() -> None:
    parts = [Part(0, SECOND, -YEARS_57, True), Part(5 * SECOND, SECOND, -YEARS_57, True)]
    spans, _, _ = spans_and_clock(parts)
    rows = {
        "stream-0": OffsetRows(*np.array([[50 * SECOND], [-2 * YEARS_57], [9]], dtype=np.int64)),
        "stream-1": OffsetRows(*np.array([[50 * SECOND], [-YEARS_57], [9]], dtype=np.int64)),
    }
    names = list(rows)
    clock = ClockTable(rows, [StreamClockFacts(name) for name in names], names)
    assert not compute_time_axis(spans, clock, period_ns=PERIOD_NS).is_shifted


def test_parts_of_one_stream_have_one_shift_also_without_frames() -> None:
    spans, clock, _ = spans_and_clock([Part(0, SECOND, YEARS_57, True), Part(SECOND, 9, 0, True)])
    behind = PartSpan(2, spans[1].stream_id, *((t, t) for t in (10**12, SERVER_NS)))
    axis = compute_time_axis([spans[0], spans[1], behind], clock, period_ns=PERIOD_NS)
    assert axis.get_shift_ns(2) == axis.get_shift_ns(1) == axis.get_shift_ns(99) != 0
    alone = PartSpan(3, "stream-1", spans[1].t_mono_ns, spans[1].t_ns)
    assert compute_time_axis([alone], None, period_ns=PERIOD_NS).shifts_ns == (0, 0, 0, 0)


@given(
    shifts_ns=st.lists(st.integers(-(10**18), 10**18), min_size=1, max_size=3),
    t_ns=st.lists(st.integers(0, 10**18), min_size=1, max_size=9),
    begin_ns=st.none() | st.integers(-(10**18), 2 * 10**18),
    end_ns=st.none() | st.integers(-(10**18), 2 * 10**18),
)
def test_no_frame_of_a_time_is_left_out(
    shifts_ns: list[int], t_ns: list[int], begin_ns: int | None, end_ns: int | None
) -> None:
    axis = TimeAxis(tuple(shifts_ns))
    part = np.arange(len(t_ns), dtype=np.uint16) % len(shifts_ns)
    at_ns = axis.shift_to_axis(np.array(t_ns, dtype=np.int64), part)
    inside = np.ones(len(t_ns), dtype=bool)
    inside &= True if begin_ns is None else at_ns >= begin_ns
    inside &= True if end_ns is None else at_ns < end_ns
    assert axis.may_overlap(min(t_ns), max(t_ns), begin_ns, end_ns) or not inside.any()


def test_it_is_read_back_as_it_was_stated() -> None:
    axis = TimeAxis((0, -YEARS_57), ("node", "server"))
    assert TimeAxis.from_json_list(axis.to_json_list(), where="x") == axis
    assert NODE_AXIS.explain_shift_or_empty() == ""
    odd: list[object] = [None, 5, [{}], [{"shift_ns": "a", "by": "node"}]]
    odd.append([{"shift_ns": 1, "by": "x"}])
    for wrong in odd:
        with pytest.raises(ValueError, match="no time axis"):
            TimeAxis.from_json_list(wrong, where="x")
