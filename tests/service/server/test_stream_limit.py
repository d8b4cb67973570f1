"""No frame of a running stream is from the future, and all of the past are taken."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.frames import FrameBatch
from service.server.streams import AHEAD_MAX_NS, StreamLimit
from storage.clock.bounds import DISCIPLINE_RATE_LIMIT
from storage.clock.log import ClockOffset
from storage.message_layout import MAX_MESSAGE_FRAMES
from tests.builders.frames import make_frames

SECOND_NS = 10**9
HOUR_NS = 3600 * SECOND_NS
HELLO_T_NS = 1_800_000_000 * SECOND_NS
MONO_NS = 7 * HOUR_NS
UTC_OFFSET_NS = 1_700_000_000 * SECOND_NS
RATE_HZ = 500.0
LIMIT = StreamLimit(HELLO_T_NS, MONO_NS, next_seq=1000, rate_hz=RATE_HZ)

since = st.integers(0, 100 * 24 * HOUR_NS)


def frames(t_mono_ns: int, seq: int = 0) -> FrameBatch:
    """Three frames, of which the middle one is the latest: order is for others to check."""
    instants = np.array([t_mono_ns - 7, t_mono_ns, t_mono_ns - 5], dtype=np.int64)
    return make_frames(np.arange(seq, seq + 3), t_mono_ns=instants)


@given(
    since_ns=since,
    gain=st.floats(-DISCIPLINE_RATE_LIMIT, DISCIPLINE_RATE_LIMIT),
    late_ns=st.integers(0, 5 * SECOND_NS),
    stopped_ns=st.integers(0, 100 * HOUR_NS),
)
def test_what_a_clock_of_any_crystal_says_is_taken_also_after_a_suspend(
    since_ns: int, gain: float, late_ns: int, stopped_ns: int
) -> None:
    """`late_ns`: how long hello was under way; `stopped_ns`: how long the node was suspended."""
    t_mono_ns = MONO_NS + late_ns + since_ns + math.floor(gain * since_ns) - stopped_ns
    assert LIMIT.describe_frames_ahead(frames(t_mono_ns), HELLO_T_NS + since_ns) == ""


@given(
    apart_ns=since,
    gain=st.floats(-DISCIPLINE_RATE_LIMIT, DISCIPLINE_RATE_LIMIT),
    late_ns=st.integers(0, 5 * SECOND_NS),
    step_ns=st.just(0) | st.integers(-(2**59), 2**59),
)
def test_a_former_measurement_applies_unless_hello_shows_another_date(
    apart_ns: int, gain: float, late_ns: int, step_ns: int
) -> None:
    """`apart_ns`: time since the measurement; `step_ns`: by how much the date was set since."""
    true_ns = HELLO_T_NS - late_ns - MONO_NS - UTC_OFFSET_NS
    row = ClockOffset(
        stream_id="a" * 32,
        t_mono_ns=MONO_NS - apart_ns,
        server_minus_node_ns=true_ns - step_ns - math.floor(gain * apart_ns),
        uncertainty_ns=SECOND_NS // 1000,
    )
    drift_ns = math.ceil(DISCIPLINE_RATE_LIMIT * apart_ns) + row.uncertainty_ns
    applies = LIMIT.is_offset_of_this_clock(row, UTC_OFFSET_NS)
    if step_ns == 0:
        assert applies
    if not -late_ns - 2 * drift_ns <= step_ns <= AHEAD_MAX_NS + 2 * drift_ns:
        assert not applies


@given(since_ns=since, back_ns=st.integers(0, 2**59))
def test_what_was_taken_in_the_past_is_taken(since_ns: int, back_ns: int) -> None:
    assert LIMIT.describe_frames_ahead(frames(MONO_NS - back_ns), HELLO_T_NS + since_ns) == ""


@given(since_ns=since, ahead_ns=st.integers(1, 2**59))
def test_what_is_dated_beyond_the_tolerance_is_not(since_ns: int, ahead_ns: int) -> None:
    tolerance_ns = AHEAD_MAX_NS + math.ceil(DISCIPLINE_RATE_LIMIT * since_ns)
    late = frames(MONO_NS + since_ns + tolerance_ns + ahead_ns)
    assert "ahead of the node's clock" in LIMIT.describe_frames_ahead(late, HELLO_T_NS + since_ns)


def test_the_tolerance_is_a_minute_beside_the_drift() -> None:
    """Figures of docs/formats.md."""
    now_t_ns = HELLO_T_NS + HOUR_NS
    for ahead_s, is_refused in ((61.7, False), (61.9, True)):
        late = frames(MONO_NS + HOUR_NS + round(ahead_s * 1e9))
        assert bool(LIMIT.describe_frames_ahead(late, now_t_ns)) is is_refused


@given(since_ns=since, taken_hz=st.floats(0.0, 1.9 * RATE_HZ))
def test_numbers_that_a_node_can_have_reached_are_taken_and_others_not(
    since_ns: int, taken_hz: float
) -> None:
    now_t_ns, since_s = HELLO_T_NS + since_ns, since_ns * 1e-9
    possible = frames(MONO_NS, 1000 + int(taken_hz * since_s))
    assert LIMIT.describe_frames_ahead(possible, now_t_ns) == ""
    beyond = 1000 + MAX_MESSAGE_FRAMES + math.ceil(2.01 * RATE_HZ * (since_s + 61))
    assert "no frame can have a number above" in LIMIT.describe_frames_ahead(
        frames(MONO_NS, beyond), now_t_ns
    )


@given(
    since_ns=since, off_ns=st.integers(-(2**59), 2**59), unsure_ns=st.integers(0, 60 * SECOND_NS)
)
def test_a_measurement_is_of_the_nodes_clock_within_what_it_may_be_off(
    since_ns: int, off_ns: int, unsure_ns: int
) -> None:
    is_near = abs(off_ns) <= AHEAD_MAX_NS + math.ceil(DISCIPLINE_RATE_LIMIT * since_ns) + unsure_ns
    now_t_ns = HELLO_T_NS + since_ns
    assert LIMIT.is_near_stated_clock(MONO_NS + since_ns + off_ns, unsure_ns, now_t_ns) == is_near


@pytest.mark.parametrize("hz", [1e-3, 1.0, 1000.0])
def test_a_slow_array_may_send_a_whole_message_at_once(hz: float) -> None:
    limit = StreamLimit(HELLO_T_NS, MONO_NS, next_seq=0, rate_hz=hz)
    assert limit.describe_frames_ahead(frames(MONO_NS, MAX_MESSAGE_FRAMES - 3), HELLO_T_NS) == ""
