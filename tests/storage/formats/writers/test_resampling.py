"""Frames at a constant rate: lines between those that follow upon each other, and no others."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.errors import UsageError
from storage.formats.writers.resampling import (
    COINCIDENCE_PERIODS,
    Resampling,
    find_consecutive_frames,
    make_resampling,
    make_sample_axis,
)
from storage.schema import Array

BEGIN_NS = 1_700_000_000_123_456_789
PERIOD_NS = 2_000_000
NOMINAL_HZ = 500.0


def at(t_ns: Array, seq: Array | None = None, part: Array | None = None, **more: int) -> Resampling:
    numbers = np.arange(len(t_ns), dtype=np.uint64) if seq is None else seq.astype(np.uint64)
    axis = make_sample_axis([(t_ns, NOMINAL_HZ)], more.get("samples_max", 10_000))
    return make_resampling(axis, t_ns, find_consecutive_frames(axis, t_ns, numbers, part))


def times(count: int) -> Array:
    return BEGIN_NS + PERIOD_NS * np.arange(count)


def test_frames_that_come_on_time_are_the_samples() -> None:
    found = at(times(100))
    values = np.random.default_rng(1).normal(size=100)
    np.testing.assert_array_equal(found.interpolate(values), values)
    np.testing.assert_array_equal(found.resample_nearest(np.arange(100)), np.arange(100))
    assert found.empty_count == 0
    assert found.axis.begin_ns == BEGIN_NS


@settings(max_examples=50)
@given(jitter=st.lists(st.integers(-700_000, 700_000), min_size=5, max_size=60))
def test_a_straight_line_is_a_straight_line_however_frames_jitter(jitter: list[int]) -> None:
    t_ns = times(len(jitter)) + np.array(jitter)
    found = at(t_ns)
    line = (t_ns - t_ns[0]) * 1e-6
    slack_ms = COINCIDENCE_PERIODS * PERIOD_NS * 1e-6 + 1e-9
    np.testing.assert_allclose(found.interpolate(line), found.elapsed_s * 1e3, atol=slack_ms)


@settings(max_examples=50)
@given(lost=st.sets(st.integers(1, 58), min_size=1, max_size=20))
def test_samples_of_lost_frames_are_empty_and_all_others_are_frames(lost: set[int]) -> None:
    kept = np.array([i for i in range(60) if i not in lost])
    found = at(times(60)[kept], kept)
    values = found.interpolate(kept.astype(np.float64))
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(values)), sorted(lost))
    np.testing.assert_array_equal(values[kept], kept)
    assert found.empty_count == len(lost)


def test_no_line_is_drawn_from_a_part_to_the_next() -> None:
    t_ns = np.append(times(10), times(10) + 10 * PERIOD_NS + 500_000)
    part = np.repeat([0, 1], 10)
    found = at(t_ns, np.arange(20), part)
    assert np.isnan(found.interpolate(np.zeros(20))).sum() == 1
    assert found.describe().endswith("1 samples are empty: frames lost, or not taken")


def test_a_slot_without_a_frame_is_bridged_and_more_are_not() -> None:
    one, three = np.delete(times(20), 5), np.delete(times(20), [5, 6, 7])
    assert at(one).empty_count == 0
    assert at(three).empty_count == 3


def test_a_flag_is_that_of_the_nearer_frame_and_no_mean() -> None:
    t_ns = times(10).copy()
    t_ns[1:] += 500_000
    flags = np.array([0, 4, 0, 4, 0, 4, 0, 4, 0, 4])
    assert set(at(t_ns).resample_nearest(flags)) <= {0.0, 4.0}


def test_a_number_that_is_not_known_makes_no_sample_beside_it() -> None:
    t_ns = times(10).copy()
    t_ns[1:] += 500_000
    values = np.arange(10.0)
    values[4] = np.nan
    assert np.isnan(at(t_ns).interpolate(values)).sum() == 2


def test_frames_at_another_rate_than_the_nominal_keep_theirs() -> None:
    found = at(BEGIN_NS + 3_000_000 * np.arange(100))
    assert found.axis.rate_hz == pytest.approx(1000 / 3)
    assert found.empty_count == 0


@pytest.mark.parametrize("count", [1, 2])
def test_few_frames_are_as_many_samples(count: int) -> None:
    assert len(at(times(count))) == count


def test_time_that_runs_back_between_parts_is_refused() -> None:
    t_ns = np.append(times(10), times(10) - 3_600_000_000_000)
    with pytest.raises(
        UsageError, match=r"time runs back by 3600\.02 s, 0\.018 s behind the first"
    ):
        at(t_ns, part=np.repeat([0, 1], 10))


def test_years_between_two_parts_are_refused_and_not_filled() -> None:
    t_ns = np.append(times(10), times(10) + 10**18)
    with pytest.raises(UsageError, match="gaps included; the limit is 10000"):
        at(t_ns, part=np.repeat([0, 1], 10))


def test_two_streams_on_one_axis_are_empty_where_they_have_no_frames() -> None:
    early, late = times(20), times(20) + 10 * PERIOD_NS + 400_000
    axis = make_sample_axis([(early, NOMINAL_HZ), (late, NOMINAL_HZ)], 100)
    assert (axis.begin_ns, axis.count) == (BEGIN_NS, 30)
    numbers = np.arange(20)
    first, second = (
        make_resampling(axis, t_ns, find_consecutive_frames(axis, t_ns, numbers, None))
        for t_ns in (early, late)
    )
    np.testing.assert_array_equal(np.flatnonzero(first.has_frames), np.arange(20))
    np.testing.assert_array_equal(np.flatnonzero(second.has_frames), np.arange(11, 30))
    values = second.interpolate(numbers.astype(np.float64))[11:]
    np.testing.assert_allclose(values, 0.8 + np.arange(19.0))
