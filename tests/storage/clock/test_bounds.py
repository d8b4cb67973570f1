"""The bound holds the truth however lopsided the network is, and is no wider than it must be."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from devices.facts import OFFSET_NS_END, T_MONO_NS_END
from storage.clock.bounds import CRYSTAL, FAST, WANDER, ClockMap, Rows, Stretch
from storage.clock.table import UNCERTAINTY_END_NS

SECOND = 1_000_000_000
HOUR = 3600 * SECOND
BEGIN_NS = 77 * SECOND
Int64 = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Clock:
    """The true offset: rates in ppm between knots ten seconds apart, and steps."""

    rates_ppm: tuple[float, ...]
    offset_ns: int = 0
    steps: tuple[tuple[int, int], ...] = ()
    """Instants after `BEGIN_NS`, and by how many ns."""

    def at(self, t_mono_ns: Int64) -> Int64:
        x = (t_mono_ns - BEGIN_NS).astype(np.float64)
        knots = np.arange(len(self.rates_ppm) + 1) * 10.0 * SECOND
        rates = np.array(self.rates_ppm) * 1e-6
        values = np.concatenate(([0.0], np.cumsum(rates * 10.0 * SECOND)))
        k = np.clip(np.searchsorted(knots, x, side="right") - 1, 0, len(rates) - 1)
        offset = self.offset_ns + np.rint(values[k] + rates[k] * (x - knots[k])).astype(np.int64)
        for after_ns, jump_ns in self.steps:
            offset += np.where(t_mono_ns - BEGIN_NS > after_ns, jump_ns, 0)
        return offset

    def measured(self, t_mono_ns: Int64, seed: int, *, slow_ns: float = 3e6) -> Rows:
        """Best of eight probes at each instant: ways back take three times as long as ways there.

        The server is read when the probe arrives; the row is about the middle of the round trip.
        """
        random = np.random.default_rng(seed)
        shape = (len(t_mono_ns), 8)
        go = np.rint(3e5 + random.exponential(slow_ns, shape)).astype(np.int64)
        back = np.rint(3e5 + random.exponential(3 * slow_ns, shape)).astype(np.int64)
        best = np.argmin(go + back, axis=1)
        rows = np.arange(len(t_mono_ns))
        go, back = go[rows, best], back[rows, best]
        sent, came = t_mono_ns, t_mono_ns + go + back
        middle = (sent + came) // 2
        server = sent + go + self.at(sent + go)
        return Rows(middle, server - middle, (came - sent + 1) // 2)


def every(seconds: float, n: int) -> Int64:
    return BEGIN_NS + np.arange(n, dtype=np.int64) * round(seconds * SECOND)


def rows_of(*rows: tuple[int, int, int]) -> Rows:
    return Rows(*np.array(rows, dtype=np.int64).T.copy())


def anywhere(rows: Rows, seed: int, n: int = 500, beyond_ns: int = 0) -> Int64:
    random = np.random.default_rng(seed + 1)
    begin, end = int(rows.t_mono_ns.min()), int(rows.t_mono_ns.max())
    drawn = random.integers(begin - beyond_ns, end + beyond_ns + 1, n)
    return np.concatenate((drawn, rows.t_mono_ns))


RATES = st.tuples(
    st.floats(-80, 80), st.floats(0, WANDER * 1e6), st.integers(2, 40), st.integers(0, 2**32)
)


def wandering(drawn: tuple[float, float, int, int]) -> Clock:
    """Rates that wander about their mean, which is drawn."""
    mean, wander, n, seed = drawn
    rates = np.random.default_rng(seed).uniform(-1, 1, n)
    rates -= rates.mean()
    rates *= wander / max(np.abs(rates).max(), 1e-9)
    return Clock(tuple(mean + rates), offset_ns=seed * 1000 - HOUR)


# --- the truth is within --------------------------------------------------------------------------


@given(drawn=RATES, seed=st.integers(0, 2**32), slow_ms=st.sampled_from([0.0, 0.1, 3.0, 200.0]))
def test_the_truth_is_within_the_bound_at_every_instant(
    drawn: tuple[float, float, int, int], seed: int, slow_ms: float
) -> None:
    clock = wandering(drawn)
    rows = clock.measured(every(10, drawn[2]), seed, slow_ns=slow_ms * 1e6)
    t_mono_ns = anywhere(rows, seed)
    offset, bound = ClockMap(rows).at(t_mono_ns)
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
    offset, bound = ClockMap(rows).at(t_mono_ns)
    assert (np.abs(offset - clock.at(t_mono_ns)) <= bound).all()
    last = int(rows.t_mono_ns[-1])
    _, later = ClockMap(rows).at(last + np.array([0, 1, 60, 3600, 36000]) * SECOND)
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
    offset, bound = ClockMap(rows).at(t_mono_ns)
    assert (np.abs(offset - clock.at(t_mono_ns)) <= bound).all()


def test_a_lopsided_network_does_not_become_a_small_bound_around_a_wrong_offset() -> None:
    # Every way there takes 0.3 ms, every way back 9.3 ms: a mean would be 4.5 ms off, and sure.
    t_mono_ns = every(10, 3600)
    rows = Rows(t_mono_ns, np.full(3600, -4_500_000), np.full(3600, 4_800_000))
    offset, bound = ClockMap(rows).at(t_mono_ns)
    assert (np.abs(offset) <= bound).all()
    assert (bound >= 4_500_000).all()


# --- and it is no wider than it must be -----------------------------------------------------------


def best_possible(rows: Rows, t_mono_ns: int) -> float:
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
        for difference, limit in ((rate, CRYSTAL), (rate - mean, WANDER)):
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
    _, bound = ClockMap(rows).at(np.array([t_mono_ns]))
    best = best_possible(rows, t_mono_ns)
    assert best - 200 <= bound[0]  # honest, to the solver's precision
    assert bound[0] < 3 * best + 200  # 1.1 in the median


def test_many_measurements_are_better_than_the_median_of_them() -> None:
    clock = Clock((40.0,))
    rows = clock.measured(every(10, 360), 3)
    _, bound = ClockMap(rows).at(rows.t_mono_ns)
    assert np.median(bound) < 0.75 * np.median(rows.uncertainty_ns)


def test_in_ten_minutes_without_link_a_known_drift_is_worth_more_than_a_crystal() -> None:
    clock = Clock((40.0,))
    rows = clock.measured(np.concatenate((every(10, 60), every(10, 60) + 1200 * SECOND)), 3)
    middle = BEGIN_NS + 900 * SECOND
    offset, bound = ClockMap(rows).at(np.array([middle]))
    assert abs(offset[0] - clock.at(np.array([middle]))[0]) <= bound[0]
    assert bound[0] < 8_000_000 < 300 * SECOND * CRYSTAL


def test_ten_minutes_after_the_link_is_gone_the_drift_is_still_worth_most_of_the_bound() -> None:
    clock = ClockMap(Clock((40.0,)).measured(every(10, 60), 3))
    end = clock.rows.t_mono_ns[-1]
    _, bound = clock.at(end + np.array([0, 600 * SECOND]))
    assert bound[1] - bound[0] < 16_000_000 < 600 * SECOND * CRYSTAL / 3


def test_the_assumptions_are_those_that_users_are_told() -> None:
    page = (Path(__file__).resolve().parents[3] / "docs" / "formats.md").read_text("utf-8")
    told = page.split("## Clocks")[1]
    for rate, where in (
        (CRYSTAL, "at most {} ppm"),
        (WANDER, "within {} ppm"),
        (FAST, "to {} ppm"),
    ):
        assert where.format(round(rate * 1e6)) in told


# --- drift ----------------------------------------------------------------------------------------


@given(drift_ppm=st.floats(-99, 99), n=st.integers(2, 60), seed=st.integers(0, 2**32))
def test_the_drift_is_within_its_bounds(drift_ppm: float, n: int, seed: int) -> None:
    (stretch,) = ClockMap(Clock((drift_ppm,)).measured(every(10, n), seed)).stretches
    slowest, fastest = stretch.mean_rate
    assert slowest - 1e-12 <= drift_ppm * 1e-6 <= fastest + 1e-12


def test_the_drift_of_ten_hours_is_known_to_a_part_in_ten_million() -> None:
    (stretch,) = ClockMap(Clock((40.0,)).measured(every(10, 3600), 1)).stretches
    assert stretch.drift_bounds is not None
    slowest, fastest = stretch.drift_bounds
    assert slowest < 40e-6 < fastest
    assert fastest - slowest < 0.3e-6


def test_one_row_has_no_drift_and_grows_by_a_crystals() -> None:
    clock = ClockMap(rows_of((BEGIN_NS, 5, 1000)))
    assert clock.stretches[0].drift_bounds is None
    offset, bound = clock.at(BEGIN_NS + np.array([-100, 0, 100]) * SECOND)
    assert offset.tolist() == [5, 5, 5]
    assert bound[1] in (1001, 1002)
    assert bound[0] == bound[2] == pytest.approx(1001 + 100 * SECOND * CRYSTAL, abs=2)


def test_a_rate_that_moves_more_than_is_assumed_widens_the_bound_and_is_no_step() -> None:
    rates = (*(30.0,) * 30, *(-30.0,) * 30)  # the node has gone from the sun into the mud
    clock = Clock(rates)
    rows = clock.measured(every(10, 60), 1, slow_ns=1e4)
    mapped = ClockMap(rows)
    assert len(mapped.stretches) == 1
    assert not mapped.stretches[0].steady
    t_mono_ns = anywhere(rows, 1)
    offset, bound = mapped.at(t_mono_ns)
    assert (np.abs(offset - clock.at(t_mono_ns)) <= bound).all()


@pytest.mark.parametrize("drift_ppm", [-400.0, 150.0, 480.0])
def test_a_clock_that_is_far_off_but_steady_has_not_stepped(drift_ppm: float) -> None:
    clock = Clock((drift_ppm,))
    rows = clock.measured(every(10, 200), 1)
    mapped = ClockMap(rows)
    assert len(mapped.stretches) == 1
    slowest, fastest = mapped.stretches[0].mean_rate
    assert slowest < drift_ppm * 1e-6 < fastest
    t_mono_ns = anywhere(rows, 1)
    offset, bound = mapped.at(t_mono_ns)
    assert (np.abs(offset - clock.at(t_mono_ns)) <= bound).all()


# --- steps ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("jump_ns", [HOUR, -HOUR, 50_000_000, -(10**18)])
def test_a_clock_that_stepped_is_seen_as_two_stretches(jump_ns: int) -> None:
    clock = Clock((20.0,), steps=((305 * SECOND, jump_ns),))
    rows = clock.measured(every(10, 60), 1)
    mapped = ClockMap(rows)
    one, other = mapped.stretches
    assert (len(one.rows), len(other.rows)) == (31, 29)
    middle = (one.end_ns + other.begin_ns) // 2
    offset, bound = mapped.at(np.array([one.end_ns, middle, other.begin_ns]))
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
    mapped = ClockMap(rows)
    one, other = mapped.stretches
    assert (len(one.rows), len(other.rows)) == (5, 4)
    _, bound = mapped.at(rows.t_mono_ns)
    assert (bound[5:8] > 250 * ms).all()
    assert (bound[5:8] < 255 * ms).all()


def test_a_step_between_the_first_two_rows_is_no_fast_clock() -> None:
    clock = Clock((20.0,), steps=((5 * SECOND, 4_000_000),))
    mapped = ClockMap(clock.measured(every(10, 60), 1, slow_ns=1e4))
    assert [len(stretch.rows) for stretch in mapped.stretches] == [1, 59]
    _, bound = mapped.at(BEGIN_NS - np.array([100 * SECOND]))
    assert bound[0] < 100 * SECOND * CRYSTAL + 2_000_000


def test_a_clock_set_forth_and_back_has_three_stretches() -> None:
    clock = Clock((5.0,), steps=((105 * SECOND, HOUR), (205 * SECOND, -HOUR)))
    assert len(ClockMap(clock.measured(every(10, 30), 1)).stretches) == 3


def test_a_step_at_every_row_is_a_stretch_for_every_row() -> None:
    rows = Rows(every(10, 2000), np.arange(2000) % 2 * HOUR, np.full(2000, 1000))
    assert len(ClockMap(rows).stretches) == 2000


# --- edges ----------------------------------------------------------------------------------------


def test_two_rows_at_the_same_instant_are_intersected() -> None:
    mapped = ClockMap(rows_of((BEGIN_NS, 0, 1000), (BEGIN_NS, 1500, 1000)))
    offset, bound = mapped.at(np.array([BEGIN_NS]))
    assert offset[0] == 750
    assert 250 <= bound[0] <= 255


def test_two_rows_at_the_same_instant_that_contradict_each_other_are_a_step_there() -> None:
    mapped = ClockMap(rows_of((BEGIN_NS, 0, 10), (BEGIN_NS, HOUR, 10)))
    assert len(mapped.stretches) == 2
    offset, _ = mapped.at(BEGIN_NS + np.array([-1, 1]))
    assert np.abs(offset - [0, HOUR]).max() <= 1


@given(st.randoms(use_true_random=False))
def test_the_order_in_which_rows_came_does_not_matter(random) -> None:  # type: ignore[no-untyped-def]
    rows = Clock((20.0,), steps=((95 * SECOND, HOUR),)).measured(every(10, 20), 1)
    order = np.array(random.sample(range(20), 20))
    shuffled = Rows(rows.t_mono_ns[order], rows.offset_ns[order], rows.uncertainty_ns[order])
    t_mono_ns = anywhere(rows, 1, beyond_ns=100 * SECOND)
    for a, b in zip(ClockMap(rows).at(t_mono_ns), ClockMap(shuffled).at(t_mono_ns), strict=True):
        assert (a == b).all()


def test_rows_without_uncertainty_are_met_to_the_nanosecond() -> None:
    t_mono_ns = every(10, 100)
    rows = Rows(t_mono_ns, np.full(100, 12345), np.zeros(100, dtype=np.int64))
    offset, bound = ClockMap(rows).at(t_mono_ns)
    assert (np.abs(offset - 12345) <= bound).all()
    assert (bound <= 3).all()
    assert (bound >= 1).all()


@pytest.mark.parametrize("end", [OFFSET_NS_END - 1, -OFFSET_NS_END + 1])
def test_the_largest_numbers_there_may_be_do_not_overflow(end: int) -> None:
    late, wide = T_MONO_NS_END - 1, UNCERTAINTY_END_NS - 1
    mapped = ClockMap(rows_of((0, end, wide), (late, -end, wide), (5, 0, 0)))
    with np.errstate(all="raise"):
        offset, bound = mapped.at(np.array([0, 5, 2**59, late, -late]))
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
    mapped = ClockMap(rows)
    t_mono_ns = np.sort(anywhere(rows, 1, beyond_ns=100 * SECOND))
    whole = mapped.at(t_mono_ns)
    ends = np.cumsum(batches(len(t_mono_ns)))
    pieces = [mapped.at(piece) for piece in np.split(t_mono_ns, ends[:-1])]
    for i in range(2):
        assert (np.concatenate([piece[i] for piece in pieces]) == whole[i]).all()


def test_no_instants_give_no_offsets() -> None:
    offset, bound = ClockMap(rows_of((BEGIN_NS, 5, 1000))).at(np.array([], dtype=np.int64))
    assert len(offset) == len(bound) == 0


def test_a_stretch_counts_its_rows_from_its_own_begin_to_its_own_end() -> None:
    stretch = Stretch(rows_of((BEGIN_NS, 5, 10), (BEGIN_NS + 1, 5, 10)))
    assert (stretch.begin_ns, stretch.end_ns) == (BEGIN_NS, BEGIN_NS + 1)
