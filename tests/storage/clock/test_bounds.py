"""Bounds of a clock's offset: they hold the truth, are hardly wider, and part at steps."""

from __future__ import annotations

from pathlib import Path
from random import Random

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from devices.arrays import Times
from devices.types import OFFSET_NS_END, T_MONO_NS_END
from storage.clock.bounds import (
    CRYSTAL_RATE_LIMIT,
    DISCIPLINE_RATE_LIMIT,
    RATE_TOLERANCE,
    ClockOffsets,
    OffsetRows,
)
from storage.clock.table import UNCERTAINTY_END_NS
from tests.storage.clock.clocks import (
    BEGIN_NS,
    HOUR,
    RATES,
    SECOND,
    Clock,
    anywhere,
    every,
    rows_of,
    wandering,
)


def assert_within(found: ClockOffsets, true: Clock, t_mono_ns: Times) -> None:
    """The true offset is within the bound at each of these instants."""
    offset, bound = found.offset_and_bound_at(t_mono_ns)
    assert (np.abs(offset - true.at(t_mono_ns)) <= bound).all()


# --- the truth is within --------------------------------------------------------------------------


@given(
    drift_ppm=st.floats(-99, 99),
    seed=st.integers(0, 2**32),
    n=st.integers(1, 30),
    hours=st.floats(0, 10),
)
def test_the_bound_grows_outside_of_the_measurements_and_holds(
    drift_ppm: float, seed: int, n: int, hours: float
) -> None:
    clock = Clock((drift_ppm,))
    rows = clock.measured(every(10, n), seed)
    t_mono_ns = anywhere(rows, seed, beyond_ns=round(hours * HOUR))
    assert_within(ClockOffsets(rows), clock, t_mono_ns)
    last = int(rows.t_mono_ns[-1])
    _, later = ClockOffsets(rows).offset_and_bound_at(
        last + np.array([0, 1, 60, 3600, 36000]) * SECOND
    )
    assert (np.diff(later) > 0).all()


@given(
    drawn=RATES,
    seed=st.integers(0, 2**32),
    slow_ms=st.sampled_from([0.0, 0.1, 3.0, 200.0]),
    steps=st.dictionaries(
        st.integers(-1, 13),  # half a minute apart: two in one gap could cancel
        st.tuples(st.integers(0, 10 * SECOND), st.sampled_from([-HOUR, HOUR, SECOND])),
        max_size=3,
    ),
)
def test_the_truth_is_within_the_bound_also_across_steps(
    drawn: tuple[float, float, int, int],
    seed: int,
    slow_ms: float,
    steps: dict[int, tuple[int, int]],
) -> None:
    plain = wandering(drawn)
    at = tuple((slot * 30 * SECOND + late_ns, by) for slot, (late_ns, by) in steps.items())
    clock = Clock(plain.rates_ppm, plain.offset_ns, at)
    rows = clock.measured(every(10, drawn[2]), seed, slow_ns=slow_ms * 1e6)
    for after_ns, _ in at:  # a probe during which the clock is set says nothing
        assume((np.abs(rows.t_mono_ns - BEGIN_NS - after_ns) > rows.uncertainty_ns).all())
    assert_within(ClockOffsets(rows), clock, anywhere(rows, seed))


@given(
    drawn=RATES,
    seed=st.integers(0, 2**32),
    jumps_ns=st.lists(st.integers(-3 * SECOND, 3 * SECOND), max_size=2),
    begin_s=st.floats(-100, 400),
    lasts_s=st.sampled_from([0.0, 1e-6, 1.0, 60.0, 300.0]),
)
def test_offsets_within_a_time_range_are_bounded(
    drawn: tuple[float, float, int, int],
    seed: int,
    jumps_ns: list[int],
    begin_s: float,
    lasts_s: float,
) -> None:
    steps = tuple((i * 100 * SECOND + 7, jump_ns) for i, jump_ns in enumerate(jumps_ns, 1))
    plain = wandering(drawn)
    stepping = Clock(plain.rates_ppm, plain.offset_ns, steps)
    clock = ClockOffsets(stepping.measured(every(10, 31), seed))
    between = BEGIN_NS + np.linspace(begin_s, begin_s + lasts_s, 301) * SECOND
    t_mono_ns = np.rint(between).astype(np.int64)
    least, greatest, sure = clock.bound_offset_in_ranges(t_mono_ns[:1], t_mono_ns[-1:])
    offset, _ = clock.offset_and_bound_at(t_mono_ns)
    assert not sure[0] or (least[0] <= offset.min() and offset.max() <= greatest[0])
    assert sure[0] or len(clock.stretches) > 1


# --- and it is no wider than it must be -----------------------------------------------------------


def best_possible(rows: OffsetRows, t_mono_ns: int) -> float:
    """Half the range of offsets at an instant that any clock within the assumptions can have.

    A linear programme over the offsets at all knots: exact, and slow.
    """
    knots = np.union1d(rows.t_mono_ns, [t_mono_ns])
    x = (knots - knots[0]) * 1e-9
    reference = int(rows.offset_ns[0])
    own = np.searchsorted(knots, rows.t_mono_ns)
    offset = (rows.offset_ns - reference) * 1e-9
    half = (rows.uncertainty_ns * (1 + 500e-6) + 1) * 1e-9
    above, limits = [], []
    unit = np.eye(len(knots))
    for k, row in enumerate(own):
        above += [unit[row], -unit[row]]
        limits += [offset[k] + half[k], half[k] - offset[k]]
    mean = (unit[own[-1]] - unit[own[0]]) / (x[own[-1]] - x[own[0]])
    for a, b in zip(range(len(knots) - 1), range(1, len(knots)), strict=True):
        rate = (unit[b] - unit[a]) / (x[b] - x[a])
        for difference, limit in ((rate, CRYSTAL_RATE_LIMIT), (rate - mean, RATE_TOLERANCE)):
            above += [difference, -difference]
            limits += [limit, limit]
    aim = unit[np.searchsorted(knots, t_mono_ns)]
    scale = 1e3  # offsets in ms: the solver's tolerance is absolute
    ends = [
        linprog(sign * aim, np.array(above), np.array(limits) * scale, bounds=(None, None))
        for sign in (1, -1)
    ]
    assert all(end.success for end in ends)
    low, high = (float(end.fun or 0.0) for end in ends)
    return -(low + high) / 2 / scale * 1e9


@settings(max_examples=60)
@given(drawn=RATES, seed=st.integers(0, 2**32), where=st.floats(0, 1))
def test_the_bound_is_hardly_wider_than_the_best_possible(
    drawn: tuple[float, float, int, int], seed: int, where: float
) -> None:
    rows = wandering(drawn).measured(every(10, min(drawn[2], 12)), seed)
    begin, end = int(rows.t_mono_ns[0]), int(rows.t_mono_ns[-1])
    t_mono_ns = begin + round(where * (end - begin))
    _, bound = ClockOffsets(rows).offset_and_bound_at(np.array([t_mono_ns]))
    best = best_possible(rows, t_mono_ns)
    assert best - 200 <= bound[0]  # honest, to the solver's precision
    assert bound[0] < 3 * best + 200  # 1.1 in the median


def test_many_measurements_narrow_the_bound() -> None:
    clock = Clock((40.0,))
    rows = clock.measured(every(10, 360), 3)
    _, bound = ClockOffsets(rows).offset_and_bound_at(rows.t_mono_ns)
    assert np.median(bound) < 0.75 * np.median(rows.uncertainty_ns)


def test_a_measured_drift_bounds_ten_minutes_without_a_link() -> None:
    clock, first = Clock((40.0,)), every(10, 60)
    between = ClockOffsets(clock.measured(np.concatenate((first, first + 1200 * SECOND)), 3))
    middle = np.array([BEGIN_NS + 900 * SECOND])
    offset, bound = between.offset_and_bound_at(middle)
    assert abs(offset[0] - clock.at(middle)[0]) <= bound[0]
    assert bound[0] < 8_000_000 < 300 * SECOND * CRYSTAL_RATE_LIMIT
    after = ClockOffsets(clock.measured(first, 3))
    end = after.rows.t_mono_ns[-1]
    _, bound = after.offset_and_bound_at(end + np.array([0, 600 * SECOND]))
    assert bound[1] - bound[0] < 16_000_000 < 600 * SECOND * CRYSTAL_RATE_LIMIT / 3


def test_the_documents_state_the_assumed_rates() -> None:
    page = (Path(__file__).resolve().parents[3] / "docs" / "formats.md").read_text("utf-8")
    told = page.split("## Clocks")[1]
    for rate, where in (
        (CRYSTAL_RATE_LIMIT, "at most {} ppm"),
        (RATE_TOLERANCE, "within {} ppm"),
        (DISCIPLINE_RATE_LIMIT, "to {} ppm"),
    ):
        assert where.format(round(rate * 1e6)) in told


# --- edges ----------------------------------------------------------------------------------------


def test_rows_of_one_instant_are_intersected_or_a_step_there() -> None:
    mapped = ClockOffsets(rows_of((BEGIN_NS, 0, 1000), (BEGIN_NS, 1500, 1000)))
    offset, bound = mapped.offset_and_bound_at(np.array([BEGIN_NS]))
    assert offset[0] == 750
    assert 250 <= bound[0] <= 255
    mapped = ClockOffsets(rows_of((BEGIN_NS, 0, 10), (BEGIN_NS, HOUR, 10)))
    assert len(mapped.stretches) == 2
    offset, _ = mapped.offset_and_bound_at(BEGIN_NS + np.array([-1, 1]))
    assert np.abs(offset - [0, HOUR]).max() <= 1


def test_any_split_into_batches_gives_the_same_bits() -> None:
    clock = Clock((20.0,), steps=((305 * SECOND, HOUR), (505 * SECOND, 1000)))
    rows = clock.measured(every(10, 60), 1)
    mapped = ClockOffsets(rows)
    t_mono_ns = np.sort(anywhere(rows, 1, beyond_ns=100 * SECOND))
    batches = np.split(t_mono_ns, [0, 0, *range(1, 100), 200])
    pieces = [mapped.offset_and_bound_at(batch) for batch in batches]
    for i, whole in enumerate(mapped.offset_and_bound_at(t_mono_ns)):
        assert (np.concatenate([piece[i] for piece in pieces]) == whole).all()


@given(st.randoms(use_true_random=False))
def test_the_order_of_rows_does_not_matter(random: Random) -> None:
    rows = Clock((20.0,), steps=((95 * SECOND, HOUR),)).measured(every(10, 20), 1)
    order = np.array(random.sample(range(20), 20))
    shuffled = OffsetRows(rows.t_mono_ns[order], rows.offset_ns[order], rows.uncertainty_ns[order])
    t_mono_ns = anywhere(rows, 1, beyond_ns=100 * SECOND)
    for a, b in zip(
        ClockOffsets(rows).offset_and_bound_at(t_mono_ns),
        ClockOffsets(shuffled).offset_and_bound_at(t_mono_ns),
        strict=True,
    ):
        assert (a == b).all()


def test_exact_rows_are_met_to_the_nanosecond() -> None:
    t_mono_ns = every(10, 100)
    rows = OffsetRows(t_mono_ns, np.full(100, 12345), np.zeros(100, dtype=np.int64))
    offset, bound = ClockOffsets(rows).offset_and_bound_at(t_mono_ns)
    assert (np.abs(offset - 12345) <= bound).all()
    assert (bound <= 3).all()
    assert (bound >= 1).all()


@pytest.mark.parametrize("end", [OFFSET_NS_END - 1, -OFFSET_NS_END + 1])
def test_the_largest_numbers_do_not_overflow(end: int) -> None:
    late, wide = T_MONO_NS_END - 1, UNCERTAINTY_END_NS - 1
    mapped = ClockOffsets(rows_of((0, end, wide), (late, -end, wide), (5, 0, 0)))
    with np.errstate(all="raise"):
        offset, bound = mapped.offset_and_bound_at(np.array([0, 5, 2**59, late, -late]))
    assert (bound >= 0).all()
    assert abs(int(offset[1])) <= int(bound[1])


# --- drift ----------------------------------------------------------------------------------------


@given(drift_ppm=st.floats(-99, 99), n=st.integers(2, 60), seed=st.integers(0, 2**32))
def test_the_drift_is_within_its_bounds(drift_ppm: float, n: int, seed: int) -> None:
    (stretch,) = ClockOffsets(Clock((drift_ppm,)).measured(every(10, n), seed)).stretches
    slowest, fastest = stretch.mean_rate_bounds
    assert slowest - 1e-12 <= drift_ppm * 1e-6 <= fastest + 1e-12


def test_the_drift_of_ten_hours_is_known_to_0_3_ppm() -> None:
    (stretch,) = ClockOffsets(Clock((40.0,)).measured(every(10, 3600), 1)).stretches
    assert stretch.narrowed_mean_rate_bounds is not None
    slowest, fastest = stretch.narrowed_mean_rate_bounds
    assert slowest < 40e-6 < fastest
    assert fastest - slowest < 0.3e-6


def test_the_bound_of_one_row_grows_by_a_crystals_rate() -> None:
    clock = ClockOffsets(rows_of((BEGIN_NS, 5, 1000)))
    assert clock.stretches[0].narrowed_mean_rate_bounds is None
    offset, bound = clock.offset_and_bound_at(BEGIN_NS + np.array([-100, 0, 100]) * SECOND)
    assert offset.tolist() == [5, 5, 5]
    assert bound[1] in (1001, 1002)
    assert bound[0] == bound[2] == pytest.approx(1001 + 100 * SECOND * CRYSTAL_RATE_LIMIT, abs=2)


def test_a_rate_that_wanders_more_than_assumed_is_no_step() -> None:
    rates = (*(30.0,) * 30, *(-30.0,) * 30)  # the node has gone from the sun into the mud
    clock = Clock(rates)
    rows = clock.measured(every(10, 60), 1, slow_ns=1e4)
    mapped = ClockOffsets(rows)
    assert len(mapped.stretches) == 1
    assert not mapped.stretches[0].is_steady
    assert_within(mapped, clock, anywhere(rows, 1))


@pytest.mark.parametrize("drift_ppm", [-400.0, 150.0, 480.0])
def test_a_fast_but_steady_clock_has_not_stepped(drift_ppm: float) -> None:
    clock = Clock((drift_ppm,))
    rows = clock.measured(every(10, 200), 1)
    mapped = ClockOffsets(rows)
    assert len(mapped.stretches) == 1
    slowest, fastest = mapped.stretches[0].mean_rate_bounds
    assert slowest < drift_ppm * 1e-6 < fastest
    assert_within(mapped, clock, anywhere(rows, 1))


# --- steps ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("jump_ns", [HOUR, -HOUR, 50_000_000, -(10**18)])
def test_a_step_parts_two_stretches(jump_ns: int) -> None:
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


def test_vague_rows_leave_open_where_the_step_was() -> None:
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


def test_a_step_at_each_row_is_a_stretch_for_each_row() -> None:
    rows = OffsetRows(every(10, 2000), np.arange(2000) % 2 * HOUR, np.full(2000, 1000))
    assert len(ClockOffsets(rows).stretches) == 2000
