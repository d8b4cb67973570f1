"""A drift is told from a step: how fast a clock runs, and where it was set, in what is measured."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from storage.clock.bounds import CRYSTAL_RATE_LIMIT, ClockOffsets, OffsetRows
from tests.storage.clock.clocks import BEGIN_NS, HOUR, SECOND, Clock, anywhere, every, rows_of

# --- drift ----------------------------------------------------------------------------------------


@given(drift_ppm=st.floats(-99, 99), n=st.integers(2, 60), seed=st.integers(0, 2**32))
def test_the_drift_is_within_its_bounds(drift_ppm: float, n: int, seed: int) -> None:
    (stretch,) = ClockOffsets(Clock((drift_ppm,)).measured(every(10, n), seed)).stretches
    slowest, fastest = stretch.mean_rate_bounds
    assert slowest - 1e-12 <= drift_ppm * 1e-6 <= fastest + 1e-12


def test_the_drift_of_ten_hours_is_known_to_a_part_in_ten_million() -> None:
    (stretch,) = ClockOffsets(Clock((40.0,)).measured(every(10, 3600), 1)).stretches
    assert stretch.narrowed_mean_rate_bounds is not None
    slowest, fastest = stretch.narrowed_mean_rate_bounds
    assert slowest < 40e-6 < fastest
    assert fastest - slowest < 0.3e-6


def test_one_row_has_no_drift_and_grows_by_a_crystals() -> None:
    clock = ClockOffsets(rows_of((BEGIN_NS, 5, 1000)))
    assert clock.stretches[0].narrowed_mean_rate_bounds is None
    offset, bound = clock.offset_and_bound_at(BEGIN_NS + np.array([-100, 0, 100]) * SECOND)
    assert offset.tolist() == [5, 5, 5]
    assert bound[1] in (1001, 1002)
    assert bound[0] == bound[2] == pytest.approx(1001 + 100 * SECOND * CRYSTAL_RATE_LIMIT, abs=2)


def test_a_rate_that_moves_more_than_is_assumed_widens_the_bound_and_is_no_step() -> None:
    rates = (*(30.0,) * 30, *(-30.0,) * 30)  # the node has gone from the sun into the mud
    clock = Clock(rates)
    rows = clock.measured(every(10, 60), 1, slow_ns=1e4)
    mapped = ClockOffsets(rows)
    assert len(mapped.stretches) == 1
    assert not mapped.stretches[0].is_steady
    t_mono_ns = anywhere(rows, 1)
    offset, bound = mapped.offset_and_bound_at(t_mono_ns)
    assert (np.abs(offset - clock.at(t_mono_ns)) <= bound).all()


@pytest.mark.parametrize("drift_ppm", [-400.0, 150.0, 480.0])
def test_a_clock_that_is_far_off_but_steady_has_not_stepped(drift_ppm: float) -> None:
    clock = Clock((drift_ppm,))
    rows = clock.measured(every(10, 200), 1)
    mapped = ClockOffsets(rows)
    assert len(mapped.stretches) == 1
    slowest, fastest = mapped.stretches[0].mean_rate_bounds
    assert slowest < drift_ppm * 1e-6 < fastest
    t_mono_ns = anywhere(rows, 1)
    offset, bound = mapped.offset_and_bound_at(t_mono_ns)
    assert (np.abs(offset - clock.at(t_mono_ns)) <= bound).all()


# --- steps ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("jump_ns", [HOUR, -HOUR, 50_000_000, -(10**18)])
def test_a_clock_that_stepped_is_seen_as_two_stretches(jump_ns: int) -> None:
    clock = Clock((20.0,), steps=((305 * SECOND, jump_ns),))
    rows = clock.measured(every(10, 60), 1)
    mapped = ClockOffsets(rows)
    one, other = mapped.stretches
    assert (len(one.rows), len(other.rows)) == (31, 29)
    middle = (one.end_t_mono_ns + other.begin_t_mono_ns) // 2
    offset, bound = mapped.offset_and_bound_at(
        np.array([one.end_t_mono_ns, middle, other.begin_t_mono_ns])
    )
    assert bound[0] < 10_000_000
    assert bound[2] < 10_000_000
    assert bound[1] > abs(jump_ns) / 2  # it is not known where the step was
    assert abs((offset[2] - offset[0]) - jump_ns) < 20_000_000


def test_rows_too_vague_to_belong_to_either_side_leave_open_where_the_step_was() -> None:
    ms = 1_000_000
    rows = rows_of(
        *((BEGIN_NS + i * 10 * SECOND, 0, ms) for i in range(5)),
        *((BEGIN_NS + i * 10 * SECOND, 0, 900 * ms) for i in range(5, 8)),
        *((BEGIN_NS + i * 10 * SECOND, 500 * ms, ms) for i in range(8, 12)),
    )
    mapped = ClockOffsets(rows)
    one, other = mapped.stretches
    assert (len(one.rows), len(other.rows)) == (5, 4)
    _, bound = mapped.offset_and_bound_at(rows.t_mono_ns)
    assert (bound[5:8] > 250 * ms).all()
    assert (bound[5:8] < 255 * ms).all()


def test_a_step_between_the_first_two_rows_is_no_fast_clock() -> None:
    clock = Clock((20.0,), steps=((5 * SECOND, 4_000_000),))
    mapped = ClockOffsets(clock.measured(every(10, 60), 1, slow_ns=1e4))
    assert [len(stretch.rows) for stretch in mapped.stretches] == [1, 59]
    _, bound = mapped.offset_and_bound_at(BEGIN_NS - np.array([100 * SECOND]))
    assert bound[0] < 100 * SECOND * CRYSTAL_RATE_LIMIT + 2_000_000


def test_a_clock_set_forth_and_back_has_three_stretches() -> None:
    clock = Clock((5.0,), steps=((105 * SECOND, HOUR), (205 * SECOND, -HOUR)))
    assert len(ClockOffsets(clock.measured(every(10, 30), 1)).stretches) == 3


def test_a_step_at_every_row_is_a_stretch_for_every_row() -> None:
    rows = OffsetRows(every(10, 2000), np.arange(2000) % 2 * HOUR, np.full(2000, 1000))
    assert len(ClockOffsets(rows).stretches) == 2000
