"""Contact, against a slow and plain reading of the same rules."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.estimation.foot.contact import (
    ContactState,
    ContactThresholds,
    is_debounced,
    update_candidate,
)

RULE = ContactThresholds(on_n=5.0, off_n=3.0, min_ns=10_000_000)
MS = 1_000_000


def contact_of(
    grf_n: list[float],
    *,
    t_ms: list[int] | None = None,
    lag_ms: int = 0,
    gaps: tuple[int, ...] = (),
) -> list[int]:
    """Contact of a recording."""
    n = len(grf_n)
    t_ns = np.array(t_ms if t_ms is not None else range(0, 2 * n, 2), dtype=np.int64) * MS
    states, since_ns, loaded = ContactState.array(1), np.empty(n, np.int64), []
    for i, force_n in enumerate(grf_n):
        update_candidate(RULE.on_n, RULE.off_n, states[0], float(force_n), t_ns[i], i in gaps)
        since_ns[i] = states["since_ns"][0]
        loaded.append(int(states["is_loaded"][0]))
    contact, out = 0, []
    for i in range(n):
        if is_debounced(since_ns, t_ns, i, n, RULE.min_ns, lag_ms * MS):
            contact = loaded[i]
        out.append(contact)
    return out


def plainly(grf_n: list[float], t_ms: list[int], lag_ms: int, gaps: tuple[int, ...]) -> list[int]:
    """The same in plain Python: runs of one seeming state, then each frame with what it can see."""
    seems: list[int] = []
    now = 0
    for force_n in grf_n:
        if force_n >= RULE.on_n:
            now = 1
        elif force_n <= RULE.off_n:
            now = 0
        seems.append(now)
    run: list[int] = []
    for i in range(len(seems)):
        before = seems[i - 1] if i else 0
        run.append((run[-1] if run else 0) + (i in gaps or seems[i] != before))
    contact, out = 0, []
    for i, t in enumerate(t_ms):
        visible = [t_ms[j] for j in range(len(t_ms)) if run[j] == run[i] and t_ms[j] <= t + lag_ms]
        # Before the first change nobody knows since when it has been so; it has been so for ever.
        if run[i] == 0 or (max(visible) - min(visible)) * MS >= RULE.min_ns:
            contact = seems[i]
        out.append(contact)
    return out


forces = st.one_of(
    st.sampled_from([0.0, -10.0, 2.9, 3.0, 3.1, 4.0, 4.9, 5.0, 5.1, 40.0, np.nan, np.inf, -np.inf]),
    st.floats(-10, 50),
)


@st.composite
def recordings(draw: st.DrawFn) -> tuple[list[float], list[int], tuple[int, ...]]:
    stretches = draw(st.lists(st.tuples(forces, st.integers(1, 8)), min_size=1, max_size=12))
    grf_n = [force for force, repeated in stretches for _ in range(repeated)]
    n = len(grf_n)
    steps = draw(st.lists(st.sampled_from([1, 2, 2, 2, 3, 5, 40]), min_size=n, max_size=n))
    gaps = draw(st.sets(st.integers(1, n), max_size=2))
    return grf_n, np.cumsum(steps).tolist(), tuple(gaps)


@settings(max_examples=300)
@given(recordings(), st.sampled_from([0, 2, 5, 10, 11, 20, 100]))
def test_contact_is_what_the_rules_say_read_one_frame_at_a_time(
    recording: tuple[list[float], list[int], tuple[int, ...]], lag_ms: int
) -> None:
    grf_n, t_ms, gaps = recording
    contact = contact_of(grf_n, t_ms=t_ms, lag_ms=lag_ms, gaps=gaps)
    assert contact == plainly(grf_n, t_ms, lag_ms, gaps)


def test_without_look_ahead_contact_comes_when_the_load_has_lasted_long_enough() -> None:
    contact = contact_of([0.0] * 3 + [20.0] * 8)
    assert contact == [0] * 3 + [0] * 5 + [1] * 3  # loaded from 6 ms on, believed at 16 ms


@pytest.mark.parametrize("lag_ms", [12, 100])
def test_with_a_long_look_ahead_contact_begins_and_ends_with_the_load(lag_ms: int) -> None:
    loads = [0.0] * 7 + [20.0] * 9 + [0.0] * 9
    assert contact_of(loads, lag_ms=lag_ms) == [int(load > 0) for load in loads]


def test_a_shorter_look_ahead_dates_contact_back_by_just_that_much() -> None:
    contact = contact_of([0.0] * 3 + [20.0] * 8, lag_ms=4)
    assert contact == [0] * 3 + [0] * 3 + [1] * 5


def test_between_the_thresholds_contact_stays_what_it_was() -> None:
    loads = [0.0] * 6 + [4.0] * 6 + [5.0] * 6 + [3.1] * 6 + [3.0] * 6 + [4.9] * 6
    assert contact_of(loads, lag_ms=100) == [0] * 12 + [1] * 12 + [0] * 12


def test_a_touch_shorter_than_the_minimum_time_is_none() -> None:
    assert contact_of([0.0] * 5 + [20.0] * 5 + [0.0] * 8, lag_ms=100) == [0] * 18  # 8 ms
    assert contact_of([0.0] * 5 + [20.0] * 6 + [0.0] * 8, lag_ms=100) == [0] * 5 + [1] * 6 + [0] * 8


def test_a_flicker_within_stance_is_no_lift() -> None:
    loads = [20.0] * 10 + [0.0] * 3 + [20.0] * 10
    assert contact_of(loads, lag_ms=100) == [1] * 23


def test_a_gap_breaks_a_run() -> None:
    # 8 ms of load before the gap and 8 ms after it are not 16 ms of load
    loads, t_ms = [0.0] + [20.0] * 10, [0, 2, 4, 6, 8, 10, 60_000, 60_002, 60_004, 60_006, 60_008]
    assert contact_of(loads, t_ms=t_ms, lag_ms=100, gaps=(6,)) == [0] * 11
    assert contact_of(loads, t_ms=t_ms, lag_ms=100_000)[1:] == [1] * 10


def test_a_frame_without_a_force_changes_nothing() -> None:
    nan = np.nan
    assert contact_of([nan] * 9, lag_ms=100) == [0] * 9
    loads = [20.0] * 3 + [nan] * 2 + [20.0] * 4 + [nan] * 9
    assert contact_of(loads, lag_ms=100) == [1] * 18


def test_a_recording_that_begins_under_load_begins_in_contact() -> None:
    assert contact_of([20.0] * 8, lag_ms=100) == [1] * 8
