"""Stances: their edges, peak, impulse and COP range."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.flags import CONTACT_UNKNOWN, EstimateFlag
from service.estimation.stances import Stance, StanceDetector, compute_stances

STEP_NS = 2_000_000
NAN = float("nan")
SATURATED = int(EstimateFlag.SATURATED)

Columns = dict[str, npt.NDArray[Any]]


def make_recording(
    grf_n: list[float],
    contact: list[int],
    *,
    seq: list[int] | None = None,
    t_ms: list[float] | None = None,
    part: list[int] | None = None,
    estimate_flags: list[int] | None = None,
    cop_x_m: list[float] | None = None,
) -> tuple[npt.NDArray[np.uint64], npt.NDArray[np.int64], Columns]:
    """Make frames 2 ms apart, numbered from 100; sigma is a tenth of the GRF."""
    n = len(grf_n)
    numbers = np.array(seq if seq is not None else range(100, 100 + n), dtype=np.uint64)
    t_ns = (numbers.astype(np.int64) - 100) * STEP_NS
    if t_ms is not None:
        t_ns = np.array([round(t * 1e6) for t in t_ms], dtype=np.int64)
    columns: Columns = {
        "contact": np.array(contact, dtype=np.uint8),
        "grf_n": np.array(grf_n, dtype=np.float64),
        "grf_sigma_n": np.array(grf_n, dtype=np.float64) / 10,
        "cop_x_m": np.array(cop_x_m or [NAN] * n, dtype=np.float64),
        "cop_sigma_x_m": np.abs(np.array(cop_x_m or [NAN] * n, dtype=np.float64)) / 10,
        "estimate_flags": np.array(estimate_flags or [0] * n, dtype=np.uint16),
    }
    if part is not None:
        columns["part"] = np.array(part, dtype=np.uint16)
    return numbers, t_ns, columns


def test_a_stance_has_peak_impulse_and_travel_of_its_frames() -> None:
    (one,) = compute_stances(
        *make_recording(
            [0, 1, 5, 3, 1, 0],
            [0, 1, 1, 1, 1, 0],
            cop_x_m=[NAN, -0.01, 0.0, 0.02, 0.015, NAN],
            estimate_flags=[128, 16, 4, 0, 0, 16],
        )
    )
    assert (one.number, one.begin_t_ns, one.end_t_ns) == (1, STEP_NS, 4 * STEP_NS)
    assert (one.peak_grf_n, one.peak_sigma_n, one.peak_t_ns) == (5.0, 0.5, 2 * STEP_NS)
    # Trapezoids of 2 ms: (1+5)/2 + (5+3)/2 + (3+1)/2 = 9 N
    assert one.impulse_n_s == pytest.approx(9 * 0.002, rel=1e-15)
    assert (one.cop_x_first_m, one.cop_x_last_m) == (-0.01, 0.015)
    assert one.cop_x_range_m == pytest.approx(0.03)
    assert one.cop_x_range_sigma_m == pytest.approx(np.hypot(0.001, 0.002))
    assert one.duration_s == pytest.approx(0.006)
    assert (one.frames, one.unknown_frames, one.missing_frames) == (4, 0, 0)
    assert one.estimate_flags == 16 | 4
    assert one.is_whole


def test_an_uncertain_cop_widens_the_range() -> None:
    x_m = [NAN, 0, 10, 9, NAN]
    numbers, t_ns, columns = make_recording([0, 5, 5, 5, 0], [0, 1, 1, 1, 0], cop_x_m=x_m)
    columns["cop_sigma_x_m"] = np.array([NAN, 0.0, 0.5, 2.0, NAN])
    (one,) = compute_stances(numbers, t_ns, columns)
    assert one.cop_x_range_m == 10.0
    greatest_high, greatest_low = 9 + 1.96 * 2.0, 10 - 1.96 * 0.5
    assert one.cop_x_range_sigma_m == pytest.approx((greatest_high - greatest_low) / (2 * 1.96))


def test_the_cop_range_is_a_lower_bound_where_a_fifth_of_the_frames_has_no_cop() -> None:
    def sigma_m(x_m: list[float]) -> float:
        (one,) = compute_stances(*make_recording([0, *[5] * 10, 0], [0, *[1] * 10, 0], cop_x_m=x_m))
        assert one.cop_x_range_m == pytest.approx(0.009)
        return one.cop_x_range_sigma_m

    x_m = [NAN, *(0.001 * k for k in range(10)), NAN]
    assert np.isfinite(sigma_m(x_m))
    assert np.isfinite(sigma_m([*x_m[:4], NAN, NAN, *x_m[6:]]))
    assert np.isnan(sigma_m([*x_m[:4], NAN, NAN, NAN, *x_m[7:]]))


def test_an_impulse_has_trapezoids_between_frames() -> None:
    (one,) = compute_stances(
        *make_recording([0, 2, 2, 4, 0], [0, 1, 1, 1, 0], t_ms=[0, 2, 12, 14, 16])
    )
    assert one.impulse_n_s == pytest.approx(2 * 0.010 + 3 * 0.002, rel=1e-15)
    assert one.is_whole


RAMP_N = [0.0, *(10.0 * k for k in range(1, 11)), *(10.0 * k for k in range(10, 0, -1)), 0.0]


def test_a_duration_is_uncertain_by_its_gaps_and_the_force_at_its_edges() -> None:
    t_ms = [0.0, *(6.0 + 2 * k for k in range(20)), 48.0]
    (one,) = compute_stances(*make_recording(RAMP_N, [0, *[1] * 20, 0], t_ms=t_ms))
    # 6 ms before it and 4 ms behind it, and 1 N of sigma at 10 N. From the frame beside it to 10 ms
    # within, 60 N come in 16 ms and go in 14 ms.
    missing_s, spread_s = 0.5 * (6e-3 + 4e-3), np.hypot(6e-3, 4e-3) / np.sqrt(12.0)
    force_s = 1.0 / 60.0 * (16e-3 + 14e-3)
    expected_s = np.sqrt(missing_s**2 + spread_s**2 + force_s**2)
    assert one.duration_sigma_s == pytest.approx(expected_s)


@pytest.mark.parametrize(
    "contact",
    [[1, 1, *[1] * 19, 0], [CONTACT_UNKNOWN, *[1] * 20, 0], [0, *[1] * 20, CONTACT_UNKNOWN]],
)
def test_a_stance_with_an_unseen_edge_has_no_uncertainty_of_its_duration(
    contact: list[int],
) -> None:
    (one,) = compute_stances(*make_recording(RAMP_N, contact))
    assert np.isnan(one.duration_sigma_s)


def test_a_slowly_rising_force_has_no_uncertainty_of_its_duration() -> None:
    slowly_n = [9.0, *(10.0 + 0.1 * k for k in range(20)), *RAMP_N[11:]]
    (one,) = compute_stances(*make_recording(slowly_n, [0, *[1] * (len(slowly_n) - 2), 0]))
    assert np.isnan(one.duration_sigma_s)


def test_an_impulse_is_uncertain_by_shared_errors_and_its_edges() -> None:
    (one,) = compute_stances(*make_recording(RAMP_N, [0, *[1] * 20, 0]))
    edges_n_s = 0.5 * (10.0 + 10.0) * 2e-3  # 10 N first and last, 2 ms before and behind
    assert one.impulse_sigma_n_s == pytest.approx(np.hypot(one.impulse_n_s / 10, edges_n_s))
    (cut,) = compute_stances(*make_recording(RAMP_N[1:-1], [1] * 20))
    assert cut.impulse_sigma_n_s == pytest.approx(cut.impulse_n_s / 10)  # of the known frames


def make_steps(
    gaps_ms: Sequence[tuple[float, float]],
    *,
    duration_ms: float = 800.0,
    is_sampled: bool = True,
    step_ms: float = 2.0,
) -> tuple[npt.NDArray[np.uint64], npt.NDArray[np.int64], Columns]:
    """Make a stance of a half sine of 50 N without the frames in gaps, in flight before and after.

    Args:
        gaps_ms: begin and end of each, after touchdown.
        duration_ms: duration.
        is_sampled: frames are lost; False: they were not sampled, so that numbers go on.
        step_ms: time between frames.
    """
    t_ms = np.arange(-300.0, duration_ms + 300.0, step_ms) + step_ms / 2
    grf_n = np.where(
        (t_ms > 0) & (t_ms < duration_ms), 50.0 * np.sin(np.pi * t_ms / duration_ms), 0.0
    )
    kept = ~np.any([(t_ms > begin) & (t_ms < end) for begin, end in gaps_ms], axis=0)
    rows = np.flatnonzero(kept) if len(gaps_ms) else np.arange(len(t_ms))
    after_gap = np.append(False, np.diff(rows) > 1)
    return make_recording(
        grf_n[rows].tolist(),
        (grf_n[rows] > 0).astype(int).tolist(),
        seq=[100 + int(row) for row in (rows if is_sampled else np.arange(len(rows)))],
        t_ms=t_ms[rows].tolist(),
        estimate_flags=[int(EstimateFlag.GAP) * int(after) for after in after_gap],
    )


@pytest.mark.parametrize("is_sampled", [True, False], ids=["lost", "not sampled"])
@pytest.mark.parametrize("gap_ms", [20.0, 60.0, 150.0])
def test_a_gap_that_is_short_against_the_stance_is_bridged(gap_ms: float, is_sampled: bool) -> None:
    (ungapped,) = compute_stances(*make_steps([]))
    (one,) = compute_stances(*make_steps([(100, 100 + gap_ms)], is_sampled=is_sampled))
    assert (one.begun, one.ended, one.is_whole) == (True, True, True)
    assert (one.begin_t_ns, one.end_t_ns) == (ungapped.begin_t_ns, ungapped.end_t_ns)
    assert one.missing_frames == (gap_ms / 2 if is_sampled else 0)
    assert one.gap_s == pytest.approx(1e-3 * (gap_ms + 2))
    # The force rises no faster than at touchdown: 50 N pi / 0.8 s.
    change_n_s = 50 * np.pi / 0.8
    shared_n_s, gap_n_s = ungapped.impulse_sigma_n_s, change_n_s * one.gap_s**2 / 4 / np.sqrt(3)
    assert one.impulse_sigma_n_s == pytest.approx(np.hypot(shared_n_s, gap_n_s), rel=0.01)
    assert abs(one.impulse_n_s - ungapped.impulse_n_s) < gap_n_s
    # The peak lies far from the gap, and has its interval.
    assert one.peak_grf_n == pytest.approx(ungapped.peak_grf_n, rel=1e-3)
    assert one.peak_sigma_n == pytest.approx(ungapped.peak_sigma_n, rel=0.1)
    assert one.duration_sigma_s == pytest.approx(ungapped.duration_sigma_s)


def test_a_stance_without_a_gap_has_none() -> None:
    (one,) = compute_stances(*make_steps([]))
    assert (one.gap_s, one.is_whole) == (0.0, True)
    slower = make_steps([], step_ms=25.0)
    assert [s.gap_s for s in compute_stances(*slower)] == [0.0]


@pytest.mark.parametrize("gap_ms", [20.0, 60.0, 150.0])
def test_a_peak_that_may_lie_in_a_gap_is_a_lower_bound(gap_ms: float) -> None:
    recording = make_steps([(400 - gap_ms / 2, 400 + gap_ms / 2)])
    for name in ("grf_n", "grf_sigma_n"):  # a precise foot
        recording[2]["grf_sigma_n"] = 0.01 * recording[2][name]
    (one,) = compute_stances(*recording)
    assert one.is_whole
    assert np.isnan(one.peak_sigma_n)
    assert one.peak_grf_n <= 50.0
    assert one.peak_t_ns is not None


def test_an_edge_in_a_gap_widens_the_duration_and_may_hide_the_peak() -> None:
    seen, late = (compute_stances(*make_steps(gaps))[0] for gaps in ([], [(-5, 100)]))
    assert (late.begun, late.ended, late.is_whole) == (True, True, True)
    gap_s = late.gap_s
    assert gap_s == pytest.approx(0.107, abs=0.002)
    assert late.duration_s == pytest.approx(seen.duration_s - 0.1, abs=0.003)
    assert late.duration_sigma_s > np.hypot(0.5 * gap_s, gap_s / np.sqrt(12))
    missing_n_s = seen.impulse_n_s - late.impulse_n_s
    assert missing_n_s < 1.96 * late.impulse_sigma_n_s
    frames = make_recording([0, 40, 39, 20, 0], [0, 1, 1, 1, 0], t_ms=[0, 40, 42, 60, 62])
    frames[2]["estimate_flags"][1] = EstimateFlag.GAP
    (tap,) = compute_stances(*frames)
    assert np.isnan(tap.peak_sigma_n)
    assert (tap.begun, tap.is_whole) == (True, False)  # the gap is longer than the rest


@pytest.mark.parametrize(
    ("gaps_ms", "duration_ms", "expected"),
    [
        ([(300, 520)], 800.0, 2),  # more than a quarter, and than 0.2 s
        ([(100, 160)], 200.0, 2),
        ([(3000, 3190)], 8000.0, 1),
        ([(3000, 3210)], 8000.0, 2),
        ([(20, 80)], 800.0, 1),  # of a short contact before it
        ([(20, 80), (100, 160), (180, 240)], 2400.0, 1),
        ([(20, 80), (100, 160), (180, 240)], 246.0, 4),
    ],
)
def test_a_gap_that_is_long_against_the_stance_cuts_it(
    gaps_ms: list[tuple[float, float]], duration_ms: float, expected: int
) -> None:
    found = compute_stances(*make_steps(gaps_ms, duration_ms=duration_ms))
    assert [one.number for one in found] == list(range(1, expected + 1))
    assert [one.is_whole for one in found] == [expected == 1] * expected
    assert (found[0].begun, found[-1].ended) == (True, True)
    assert not any(one.ended for one in found[:-1])
    assert not any(one.begun for one in found[1:])


def test_gaps_of_more_than_a_quarter_of_the_stance_leave_no_impulse() -> None:
    gaps_ms = [(at, at + 45.0) for at in range(100, 700, 100)]  # 6 of 47 ms
    (one,) = compute_stances(*make_steps(gaps_ms))
    assert (one.begun, one.ended, one.is_whole) == (True, True, False)
    assert one.gap_s > 0.25 * one.duration_s
    assert np.isnan([one.impulse_n_s, one.impulse_sigma_n_s]).all()
    assert np.isfinite(one.duration_sigma_s)


def test_a_cop_range_with_gaps_of_more_than_a_twentieth_is_a_lower_bound() -> None:
    def is_bound(gaps_ms: list[tuple[float, float]]) -> bool:
        seq, t_ns, columns = make_steps(gaps_ms)
        columns["cop_x_m"] = np.where(columns["contact"] == 1, 1e-10 * t_ns, NAN)
        columns["cop_sigma_x_m"] = np.where(columns["contact"] == 1, 0.001, NAN)
        (one,) = compute_stances(seq, t_ns, columns)
        return bool(np.isnan(one.cop_x_range_sigma_m))

    assert not is_bound([(300, 335)])  # of 800 ms
    assert is_bound([(300, 345)])
    assert is_bound([(-5, 45)])
    assert is_bound([(760, 810)])
    assert is_bound([(300, 320), (500, 525)])


def test_a_stance_that_begins_before_contact_is_known_has_no_begin() -> None:
    grf_n, unsure = [8.0, 9, 9, 8, 0, 0, 5, 0], CONTACT_UNKNOWN
    first, second = compute_stances(*make_recording(grf_n, [unsure, unsure, 1, 1, 0, 0, 1, 0]))
    assert (first.begun, first.ended, first.is_whole) == (False, True, False)
    assert np.isnan(first.duration_sigma_s)
    assert second.is_whole
    # Never before a stance of another run of the node.
    part = [0] * 2 + [1] * 4
    parts = make_recording([0, 0, 9, 9, 9, 0], [0, 0, unsure, 1, 1, 0], part=part)
    (cut,) = compute_stances(*parts)
    assert (cut.begun, cut.ended) == (False, True)


def test_stances_at_the_ends_of_a_recording_are_not_whole() -> None:
    first, last = compute_stances(*make_recording([4, 4, 0, 4, 4], [1, 1, 0, 1, 1]))
    assert (first.number, first.begun, first.ended, first.is_whole) == (1, False, True, False)
    assert (last.number, last.begun, last.ended, last.is_whole) == (2, True, False, False)


@pytest.mark.parametrize("cut", range(1, 30))
def test_unknown_frames_in_a_bridged_gap_count_in_any_batch(cut: int) -> None:
    # 20 frames, four unknown ones 2 ms apart, 60 ms, 20 frames.
    contact = [0, *[1] * 20, *[CONTACT_UNKNOWN] * 4, *[1] * 100, 0]
    t_ms = [2.0 * k + (60.0 if k > 24 else 0.0) for k in range(len(contact))]
    seq, t_ns, columns = make_recording([5.0] * len(contact), contact, t_ms=t_ms)
    detector, found = StanceDetector(), list[Stance]()
    for rows in (slice(0, cut), slice(cut, None)):
        found += detector.add_frames(
            seq[rows], t_ns[rows], {k: v[rows] for k, v in columns.items()}
        )
    (one,) = [*found, *detector.finish()]
    assert (one.frames, one.unknown_frames) == (124, 4)
    assert one.gap_s == pytest.approx(0.070)


def test_frames_of_unknown_contact_within_a_stance_are_a_gap() -> None:
    unsure = CONTACT_UNKNOWN
    grf_n = [0, 2, *range(3, 18), NAN, NAN, 8, 4, 0]
    contact = [0, *[1] * 16, unsure, unsure, 1, 1, 0]
    flags = [32 if np.isnan(force) else 0 for force in grf_n]
    (one,) = compute_stances(*make_recording(grf_n, contact, estimate_flags=flags))
    assert (one.frames, one.unknown_frames, one.missing_frames) == (20, 2, 0)
    assert one.gap_s == pytest.approx(0.006)
    known_n_s = np.trapezoid(np.array(grf_n[1:17] + grf_n[19:21]), 2e-3 * np.r_[0:16, 18:20])
    assert one.impulse_n_s == pytest.approx(known_n_s)
    assert one.estimate_flags == 32
    assert (one.begun, one.ended, one.is_whole) == (True, True, True)


@pytest.mark.parametrize(
    ("contact", "seq"),
    [
        ([0, 1, 1, 0], [100, 102, 103, 104]),
        ([0, 1, 1, 0], [100, 101, 102, 104]),
        ([0, CONTACT_UNKNOWN, 1, 0], [100, 101, 102, 103]),
        ([0, 1, CONTACT_UNKNOWN, 0], [100, 101, 102, 103]),
    ],
)
def test_an_edge_beside_missing_or_unknown_frames_is_a_gap(
    contact: list[int], seq: list[int]
) -> None:
    (one,) = compute_stances(*make_recording([0, 5, 5, 0], contact, seq=seq))
    assert one.missing_frames == 0
    assert one.gap_s == pytest.approx(0.004)
    assert (one.begun, one.ended) == (True, True)
    assert not one.is_whole  # the gap is longer than the rest


def test_frames_of_unknown_contact_at_an_edge_belong_to_no_stance() -> None:
    frames = make_recording(
        [NAN, 5, 5, NAN, 0],
        [CONTACT_UNKNOWN, 1, 1, CONTACT_UNKNOWN, 0],
        estimate_flags=[32, 0, 0, 32, 0],
    )
    (one,) = compute_stances(*frames)
    assert (one.begin_t_ns, one.end_t_ns, one.frames) == (STEP_NS, 2 * STEP_NS, 2)
    assert (one.estimate_flags, one.unknown_frames) == (0, 0)


@pytest.mark.parametrize(("t_ms", "expected"), [(54.0, 1), (54.001, 2)])
def test_a_foot_unseen_for_more_than_50_ms_may_have_been_lifted(t_ms: float, expected: int) -> None:
    # Known at 4 ms and at t_ms.
    contact, grf_n = [0, 1, 1, CONTACT_UNKNOWN, 1, 0], [0, 5, 5, NAN, 7, 0]
    found = compute_stances(*make_recording(grf_n, contact, t_ms=[0, 2, 4, 6, t_ms, t_ms + 2]))
    assert len(found) == expected
    assert [s.number for s in found] == list(range(1, expected + 1))
    assert found[0].begun
    assert found[-1].ended
    assert not any(s.is_whole for s in found)


def test_a_restart_of_the_node_ends_a_stance() -> None:
    before, after = compute_stances(
        *make_recording(
            [0, 5, 5, 6, 6, 0],
            [0, 1, 1, 1, 1, 0],
            seq=[7, 8, 9, 10, 11, 12],
            part=[0] * 3 + [1] * 3,
        )
    )
    assert (before.part, before.begun, before.ended) == (0, True, False)
    assert (after.part, after.begun, after.ended) == (1, False, True)


def test_a_stance_without_a_known_force_has_no_peak() -> None:
    (one,) = compute_stances(*make_recording([0, NAN, 0], [0, 1, 0]))
    assert np.isnan([one.peak_grf_n, one.peak_sigma_n, one.impulse_n_s, one.cop_x_range_m]).all()
    assert (one.peak_t_ns, one.is_whole) == (None, False)


def test_a_saturated_stance_has_neither_peak_nor_impulse() -> None:
    grf_n, contact = [0, 3, NAN, 4, 0, 5, 0], [0, 1, 1, 1, 0, 1, 0]
    hidden, whole = compute_stances(
        *make_recording(grf_n, contact, estimate_flags=[0, 0, SATURATED, 0, 0, 0, 0])
    )
    assert np.isnan([hidden.peak_grf_n, hidden.impulse_n_s]).all()
    assert (hidden.peak_t_ns, hidden.unknown_frames) == (None, 1)
    assert (whole.number, whole.peak_grf_n, whole.is_whole) == (2, 5.0, True)


def test_a_foot_in_the_air_has_no_stance() -> None:
    assert compute_stances(*make_recording([0.0] * 5, [0] * 5)) == []
    assert compute_stances(*make_recording([], [])) == []
    assert compute_stances(*make_recording([NAN] * 3, [CONTACT_UNKNOWN] * 3)) == []


def test_a_stance_is_reported_as_soon_as_it_is_over() -> None:
    seq, t_ns, columns = make_recording([0, 4, 0, 0], [0, 1, 0, 0])
    detector = StanceDetector()
    found = [
        detector.add_frames(
            seq[i : i + 1], t_ns[i : i + 1], {k: v[i : i + 1] for k, v in columns.items()}
        )
        for i in range(4)
    ]
    assert [len(over) for over in found] == [0, 0, 1, 0]
    assert detector.finish() == []


@st.composite
def recordings(draw: st.DrawFn) -> tuple[Any, ...]:
    n = draw(st.integers(1, 40))
    contact = draw(st.lists(st.sampled_from([0, 1, 1, CONTACT_UNKNOWN]), min_size=n, max_size=n))
    steps = draw(st.lists(st.sampled_from([1, 1, 1, 1, 3, 30, 90]), min_size=n, max_size=n))
    part = np.cumsum(draw(st.lists(st.sampled_from([0] * 9 + [1]), min_size=n, max_size=n)))
    rng = np.random.default_rng(draw(st.integers(0, 9)))
    forces = [float(f) for f in np.where(rng.random(n) < 0.1, NAN, rng.uniform(0, 20, n))]
    estimate_flags = [int(s) for s in rng.choice([0, 0, 0, 1, 32], n)]
    cop_x_m = [float(x) for x in np.where(rng.random(n) < 0.3, NAN, rng.normal(0, 0.02, n))]
    seq = [100 + int(s) for s in np.cumsum(steps)]
    parts = [int(p) for p in part]
    return make_recording(
        forces, contact, seq=seq, part=parts, estimate_flags=estimate_flags, cop_x_m=cop_x_m
    )


@settings(max_examples=50, deadline=None)
@given(frames=recordings(), cuts=st.sets(st.integers(0, 40), max_size=6))
def test_any_batches_give_the_same_stances(frames: Any, cuts: set[int]) -> None:
    seq, t_ns, columns = frames
    detector, found = StanceDetector(), list[Stance]()
    for rows in np.split(np.arange(len(seq)), sorted(c for c in cuts if c <= len(seq))):
        found += detector.add_frames(
            seq[rows], t_ns[rows], {k: v[rows] for k, v in columns.items()}
        )
    found += detector.finish()
    # By its digits: NaN is not equal to itself.
    assert repr(found) == repr(compute_stances(seq, t_ns, columns))


@settings(max_examples=50, deadline=None)
@given(frames=recordings())
def test_every_frame_of_contact_is_in_one_stance(frames: Any) -> None:
    seq, t_ns, columns = frames
    found = compute_stances(seq, t_ns, columns)
    assert [s.number for s in found] == list(range(1, len(found) + 1))
    assert all(a.end_t_ns < b.begin_t_ns for a, b in pairwise(found))
    inside = [(s.begin_t_ns <= t_ns) & (t_ns <= s.end_t_ns) for s in found]
    loaded = columns["contact"] == 1
    assert (np.sum(inside, axis=0) == 1)[loaded].all() if found else not loaded.any()
    for stance, rows in zip(found, inside, strict=True):
        assert stance.frames == rows.sum()
        assert not (columns["contact"][rows] == 0).any()
        assert stance.estimate_flags == np.bitwise_or.reduce(columns["estimate_flags"][rows])
