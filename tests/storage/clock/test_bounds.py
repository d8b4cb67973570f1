"""The bound holds the truth however lopsided the network is, and is no wider than it must be."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from random import Random

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from devices.types import OFFSET_NS_END, T_MONO_NS_END
from storage.clock.bounds import (
    CRYSTAL_RATE_LIMIT,
    DISCIPLINE_RATE_LIMIT,
    RATE_TOLERANCE,
    ClockOffsets,
    OffsetRows,
    OffsetStretch,
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

# --- the truth is within --------------------------------------------------------------------------


@given(drawn=RATES, seed=st.integers(0, 2**32), slow_ms=st.sampled_from([0.0, 0.1, 3.0, 200.0]))
def test_the_truth_is_within_the_bound_at_every_instant(
    drawn: tuple[float, float, int, int], seed: int, slow_ms: float
) -> None:
    clock = wandering(drawn)
    rows = clock.measured(every(10, drawn[2]), seed, slow_ns=slow_ms * 1e6)
    t_mono_ns = anywhere(rows, seed)
    offset, bound = ClockOffsets(rows).offset_and_bound_at(t_mono_ns)
    assert (np.abs(offset - clock.at(t_mono_ns)) <= bound).all()


@given(
    drift_ppm=st.floats(-99, 99),
    seed=st.integers(0, 2**32),
    n=st.integers(1, 30),
    hours=st.floats(0, 10),
)
def test_before_and_after_the_measurements_the_bound_grows_and_holds(
    drift_ppm: float, seed: int, n: int, hours: float
) -> None:
    clock = Clock((drift_ppm,))
    rows = clock.measured(every(10, n), seed)
    t_mono_ns = anywhere(rows, seed, beyond_ns=round(hours * HOUR))
    offset, bound = ClockOffsets(rows).offset_and_bound_at(t_mono_ns)
    assert (np.abs(offset - clock.at(t_mono_ns)) <= bound).all()
    last = int(rows.t_mono_ns[-1])
    _, later = ClockOffsets(rows).offset_and_bound_at(
        last + np.array([0, 1, 60, 3600, 36000]) * SECOND
    )
    assert (np.diff(later) > 0).all()


@given(
    drawn=RATES,
    seed=st.integers(0, 2**32),
    steps=st.dictionaries(
        st.integers(-1, 13),  # half a minute apart: two in one gap could cancel
        st.tuples(st.integers(0, 10 * SECOND), st.sampled_from([-HOUR, HOUR, SECOND])),
        max_size=3,
    ),
)
def test_the_truth_is_within_the_bound_beside_steps_and_across_them(
    drawn: tuple[float, float, int, int], seed: int, steps: dict[int, tuple[int, int]]
) -> None:
    plain = wandering(drawn)
    at = tuple((slot * 30 * SECOND + late_ns, by) for slot, (late_ns, by) in steps.items())
    clock = Clock(plain.rates_ppm, plain.offset_ns, at)
    rows = clock.measured(every(10, drawn[2]), seed)
    for after_ns, _ in at:  # a probe during which the clock is set says nothing
        assume((np.abs(rows.t_mono_ns - BEGIN_NS - after_ns) > rows.uncertainty_ns).all())
    t_mono_ns = anywhere(rows, seed)
    offset, bound = ClockOffsets(rows).offset_and_bound_at(t_mono_ns)
    assert (np.abs(offset - clock.at(t_mono_ns)) <= bound).all()


@given(
    drawn=RATES,
    seed=st.integers(0, 2**32),
    jumps_ns=st.lists(st.integers(-3 * SECOND, 3 * SECOND), max_size=2),
    begin_s=st.floats(-100, 400),
    lasts_s=st.sampled_from([0.0, 1e-6, 1.0, 60.0, 300.0]),
)
def test_no_offset_between_two_instants_is_out_of_reach(
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


def test_a_lopsided_network_does_not_become_a_small_bound_around_a_wrong_offset() -> None:
    # Every way there takes 0.3 ms, every way back 9.3 ms: a mean would be 4.5 ms off, and sure.
    t_mono_ns = every(10, 3600)
    rows = OffsetRows(t_mono_ns, np.full(3600, -4_500_000), np.full(3600, 4_800_000))
    offset, bound = ClockOffsets(rows).offset_and_bound_at(t_mono_ns)
    assert (np.abs(offset) <= bound).all()
    assert (bound >= 4_500_000).all()


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
def test_the_bound_is_hardly_wider_than_the_best_there_can_be(
    drawn: tuple[float, float, int, int], seed: int, where: float
) -> None:
    rows = wandering(drawn).measured(every(10, min(drawn[2], 12)), seed)
    begin, end = int(rows.t_mono_ns[0]), int(rows.t_mono_ns[-1])
    t_mono_ns = begin + round(where * (end - begin))
    _, bound = ClockOffsets(rows).offset_and_bound_at(np.array([t_mono_ns]))
    best = best_possible(rows, t_mono_ns)
    assert best - 200 <= bound[0]  # honest, to the solver's precision
    assert bound[0] < 3 * best + 200  # 1.1 in the median


def test_many_measurements_are_better_than_the_median_of_them() -> None:
    clock = Clock((40.0,))
    rows = clock.measured(every(10, 360), 3)
    _, bound = ClockOffsets(rows).offset_and_bound_at(rows.t_mono_ns)
    assert np.median(bound) < 0.75 * np.median(rows.uncertainty_ns)


def test_in_ten_minutes_without_link_a_known_drift_is_worth_more_than_a_crystal() -> None:
    clock = Clock((40.0,))
    rows = clock.measured(np.concatenate((every(10, 60), every(10, 60) + 1200 * SECOND)), 3)
    middle = BEGIN_NS + 900 * SECOND
    offset, bound = ClockOffsets(rows).offset_and_bound_at(np.array([middle]))
    assert abs(offset[0] - clock.at(np.array([middle]))[0]) <= bound[0]
    assert bound[0] < 8_000_000 < 300 * SECOND * CRYSTAL_RATE_LIMIT


def test_ten_minutes_after_the_link_is_gone_the_drift_is_still_worth_most_of_the_bound() -> None:
    clock = ClockOffsets(Clock((40.0,)).measured(every(10, 60), 3))
    end = clock.rows.t_mono_ns[-1]
    _, bound = clock.offset_and_bound_at(end + np.array([0, 600 * SECOND]))
    assert bound[1] - bound[0] < 16_000_000 < 600 * SECOND * CRYSTAL_RATE_LIMIT / 3


def test_the_assumptions_are_those_that_users_are_told() -> None:
    page = (Path(__file__).resolve().parents[3] / "docs" / "formats.md").read_text("utf-8")
    told = page.split("## Clocks")[1]
    for rate, where in (
        (CRYSTAL_RATE_LIMIT, "at most {} ppm"),
        (RATE_TOLERANCE, "within {} ppm"),
        (DISCIPLINE_RATE_LIMIT, "to {} ppm"),
    ):
        assert where.format(round(rate * 1e6)) in told


# --- edges ----------------------------------------------------------------------------------------


def test_two_rows_at_the_same_instant_are_intersected() -> None:
    mapped = ClockOffsets(rows_of((BEGIN_NS, 0, 1000), (BEGIN_NS, 1500, 1000)))
    offset, bound = mapped.offset_and_bound_at(np.array([BEGIN_NS]))
    assert offset[0] == 750
    assert 250 <= bound[0] <= 255


def test_two_rows_at_the_same_instant_that_contradict_each_other_are_a_step_there() -> None:
    mapped = ClockOffsets(rows_of((BEGIN_NS, 0, 10), (BEGIN_NS, HOUR, 10)))
    assert len(mapped.stretches) == 2
    offset, _ = mapped.offset_and_bound_at(BEGIN_NS + np.array([-1, 1]))
    assert np.abs(offset - [0, HOUR]).max() <= 1


@given(st.randoms(use_true_random=False))
def test_the_order_in_which_rows_came_does_not_matter(random: Random) -> None:
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


def test_rows_without_uncertainty_are_met_to_the_nanosecond() -> None:
    t_mono_ns = every(10, 100)
    rows = OffsetRows(t_mono_ns, np.full(100, 12345), np.zeros(100, dtype=np.int64))
    offset, bound = ClockOffsets(rows).offset_and_bound_at(t_mono_ns)
    assert (np.abs(offset - 12345) <= bound).all()
    assert (bound <= 3).all()
    assert (bound >= 1).all()


@pytest.mark.parametrize("end", [OFFSET_NS_END - 1, -OFFSET_NS_END + 1])
def test_the_largest_numbers_there_may_be_do_not_overflow(end: int) -> None:
    late, wide = T_MONO_NS_END - 1, UNCERTAINTY_END_NS - 1
    mapped = ClockOffsets(rows_of((0, end, wide), (late, -end, wide), (5, 0, 0)))
    with np.errstate(all="raise"):
        offset, bound = mapped.offset_and_bound_at(np.array([0, 5, 2**59, late, -late]))
    assert (bound >= 0).all()
    assert abs(int(offset[1])) <= int(bound[1])


@pytest.mark.parametrize(
    "batches",
    [lambda n: [n], lambda n: [1] * n, lambda n: [7] * (n // 7) + [n % 7]],
    ids=["all", "one by one", "by seven"],
)
def test_any_split_into_batches_gives_the_same_bits(batches: Callable[[int], list[int]]) -> None:
    clock = Clock((20.0,), steps=((305 * SECOND, HOUR), (505 * SECOND, 1000)))
    rows = clock.measured(every(10, 60), 1)
    mapped = ClockOffsets(rows)
    t_mono_ns = np.sort(anywhere(rows, 1, beyond_ns=100 * SECOND))
    whole = mapped.offset_and_bound_at(t_mono_ns)
    ends = np.cumsum(batches(len(t_mono_ns)))
    pieces = [mapped.offset_and_bound_at(piece) for piece in np.split(t_mono_ns, ends[:-1])]
    for i in range(2):
        assert (np.concatenate([piece[i] for piece in pieces]) == whole[i]).all()


def test_no_instants_give_no_offsets() -> None:
    offset, bound = ClockOffsets(rows_of((BEGIN_NS, 5, 1000))).offset_and_bound_at(
        np.array([], dtype=np.int64)
    )
    assert len(offset) == len(bound) == 0


def test_a_stretch_counts_its_rows_from_its_own_begin_to_its_own_end() -> None:
    stretch = OffsetStretch(rows_of((BEGIN_NS, 5, 10), (BEGIN_NS + 1, 5, 10)))
    assert (stretch.begin_t_mono_ns, stretch.end_t_mono_ns) == (BEGIN_NS, BEGIN_NS + 1)
