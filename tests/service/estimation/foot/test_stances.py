"""Stances: where a contact begins and ends, its peak and its impulse."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.estimation.foot.stances import UNKNOWN, Stance, Stances

STEP_NS = 2_000_000


def stances_of(
    grf_n: list[float],
    contact: list[int],
    cuts: tuple[int, ...] = (),
    saturated: tuple[int, ...] = (),
) -> tuple[Stance, ...]:
    t_ns = np.arange(len(grf_n), dtype=np.int64) * STEP_NS
    gathered = Stances()
    hidden = np.isin(np.arange(len(grf_n)), saturated)
    forces_n, contacts = np.array(grf_n), np.array(contact, dtype=np.uint8)
    for rows in np.split(np.arange(len(grf_n)), sorted(cuts)):
        gathered.feed(t_ns[rows], forces_n[rows], contacts[rows], hidden[rows])
    return gathered.finish()


def test_a_stance_has_the_peak_and_the_impulse_of_its_frames() -> None:
    (one,) = stances_of([0, 1, 5, 3, 1, 0], [0, 1, 1, 1, 1, 0])
    assert (one.begin_t_ns, one.end_t_ns) == (STEP_NS, 4 * STEP_NS)
    assert (one.peak_n, one.peak_t_ns) == (5.0, 2 * STEP_NS)
    # Trapezoids of 2 ms: (1+5)/2 + (5+3)/2 + (3+1)/2 = 9 N
    assert one.impulse_ns == pytest.approx(9 * 0.002, rel=1e-15)
    assert one.duration_s == pytest.approx(0.006)
    assert (one.begun, one.ended, one.unknown_frames) == (True, True, 0)


def test_stances_at_the_ends_of_a_recording_say_that_they_are_cut() -> None:
    first, last = stances_of([4, 4, 0, 4, 4], [1, 1, 0, 1, 1])
    assert (first.begun, first.ended) == (False, True)
    assert (last.begun, last.ended) == (True, False)


def test_frames_without_a_force_are_counted_and_gone_over_in_a_straight_line() -> None:
    (one,) = stances_of([0, 2, np.nan, np.nan, 8, 0], [0, 1, UNKNOWN, UNKNOWN, 1, 0])
    assert one.unknown_frames == 2
    assert one.impulse_ns == pytest.approx(5.0 * 0.006)
    assert one.peak_n == 8.0


def test_a_stance_of_which_no_force_is_known_has_no_peak() -> None:
    (one,) = stances_of([0, np.nan, 0], [0, 1, 0])
    assert np.isnan(one.peak_n)
    assert one.impulse_ns == 0.0


def test_a_stance_in_which_a_tile_was_saturated_has_neither_peak_nor_impulse_and_the_next_has() -> (
    None
):
    grf_n = [0, 3, np.nan, 4, 0, 5, 0]
    hidden, whole = stances_of(grf_n, [0, 1, 1, 1, 0, 1, 0], (3,), saturated=(2,))
    assert np.isnan([hidden.peak_n, hidden.impulse_ns]).all()
    assert (hidden.peak_t_ns, hidden.unknown_frames) == (STEP_NS, 1)
    assert whole.peak_n == 5.0


def test_a_foot_in_the_air_has_no_stance() -> None:
    assert stances_of([0.0] * 5, [0] * 5) == ()
    assert stances_of([], []) == ()
    assert stances_of([np.nan] * 3, [UNKNOWN] * 3) == ()


@given(
    contact=st.lists(st.sampled_from([0, 1, UNKNOWN]), min_size=1, max_size=40),
    cuts=st.sets(st.integers(0, 40), max_size=6),
)
def test_any_batches_give_the_same_stances(contact: list[int], cuts: set[int]) -> None:
    rng = np.random.default_rng(len(contact))
    grf_n = [float(f) for f in rng.uniform(0, 20, len(contact))]
    whole = stances_of(grf_n, contact)
    assert stances_of(grf_n, contact, tuple(c for c in cuts if c <= len(contact))) == whole
