"""Contact, against a slow and plain reading of the same rules."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.estimation.foot import ContactState, is_debounced, update_candidate

ON_N, OFF_N, MIN_NS = 5.0, 3.0, 10_000_000
MS = 1_000_000


def detect_contact(
    grf_n: list[float],
    *,
    t_ms: list[int] | None = None,
    lag_ms: int = 0,
    gaps: tuple[int, ...] = (),
) -> list[int]:
    """Detect the contact of a recording; frames are 2 ms apart by default."""
    n = len(grf_n)
    t_ns = np.array(t_ms if t_ms is not None else range(0, 2 * n, 2), dtype=np.int64) * MS
    states, since_ns, loaded = ContactState.array(1), np.empty(n, np.int64), []
    for i, force_n in enumerate(grf_n):
        update_candidate(ON_N, OFF_N, states[0], float(force_n), t_ns[i], i in gaps)
        since_ns[i] = states["since_ns"][0]
        loaded.append(int(states["is_loaded"][0]))
    contact, out = 0, []
    for i in range(n):
        if is_debounced(since_ns, t_ns, i, n, MIN_NS, lag_ms * MS):
            contact = loaded[i]
        out.append(contact)
    return out


def detect_plainly(
    grf_n: list[float], t_ms: list[int], lag_ms: int, gaps: tuple[int, ...]
) -> list[int]:
    """Detect contact by runs of one candidate, then by each frame's visible frames."""
    candidates: list[int] = []
    for force_n in grf_n:
        before = candidates[-1] if candidates else 0
        candidates.append(1 if force_n >= ON_N else 0 if force_n <= OFF_N else before)
    changes = np.diff(candidates, prepend=0) != 0
    run = np.cumsum([i in gaps or changes[i] for i in range(len(grf_n))])
    contact, out = 0, []
    for i, t in enumerate(t_ms):
        visible = [t_ms[j] for j in range(len(t_ms)) if run[j] == run[i] and t_ms[j] <= t + lag_ms]
        # The first run has no known begin: it counts as long.
        if run[i] == 0 or (max(visible) - min(visible)) * MS >= MIN_NS:
            contact = candidates[i]
        out.append(contact)
    return out


FORCES = st.one_of(
    st.sampled_from([0.0, -10.0, 2.9, 3.0, 3.1, 4.0, 4.9, 5.0, 5.1, 40.0, np.nan, np.inf, -np.inf]),
    st.floats(-10, 50),
)


@st.composite
def recordings(draw: st.DrawFn) -> tuple[list[float], list[int], tuple[int, ...]]:
    stretches = draw(st.lists(st.tuples(FORCES, st.integers(1, 8)), min_size=1, max_size=12))
    grf_n = [force for force, repeated in stretches for _ in range(repeated)]
    n = len(grf_n)
    steps = draw(st.lists(st.sampled_from([1, 2, 2, 2, 3, 5, 40]), min_size=n, max_size=n))
    gaps = draw(st.sets(st.integers(1, n), max_size=2))
    return grf_n, np.cumsum(steps).tolist(), tuple(gaps)


@settings(max_examples=200)
@given(recordings(), st.sampled_from([0, 2, 5, 10, 11, 20, 100]))
def test_contact_follows_its_rules(
    recording: tuple[list[float], list[int], tuple[int, ...]], lag_ms: int
) -> None:
    grf_n, t_ms, gaps = recording
    contact = detect_contact(grf_n, t_ms=t_ms, lag_ms=lag_ms, gaps=gaps)
    assert contact == detect_plainly(grf_n, t_ms, lag_ms, gaps)


STEP_N = [0.0] * 3 + [20.0] * 8
AROUND_A_MINUTE_MS = [0, 2, 4, 6, 8, 10, 60_000, 60_002, 60_004, 60_006, 60_008]


@pytest.mark.parametrize(
    ("grf_n", "options", "contact"),
    [
        # Loaded from 6 ms on, certain at 16 ms.
        (STEP_N, {"lag_ms": 0}, [0] * 8 + [1] * 3),
        (STEP_N, {"lag_ms": 4}, [0] * 6 + [1] * 5),
        ([0.0] * 7 + [20.0] * 9 + [0.0] * 9, {"lag_ms": 12}, [0] * 7 + [1] * 9 + [0] * 9),
        (
            [0.0] * 6 + [4.0] * 6 + [5.0] * 6 + [3.1] * 6 + [3.0] * 6 + [4.9] * 6,
            {},
            [0] * 12 + [1] * 12 + [0] * 12,
        ),
        ([0.0] * 5 + [20.0] * 5 + [0.0] * 8, {}, [0] * 18),
        ([0.0] * 5 + [20.0] * 6 + [0.0] * 8, {}, [0] * 5 + [1] * 6 + [0] * 8),
        ([20.0] * 10 + [0.0] * 3 + [20.0] * 10, {}, [1] * 23),
        # 8 ms of load before the gap and 8 ms after it are not 16 ms of load.
        ([0.0] + [20.0] * 10, {"t_ms": AROUND_A_MINUTE_MS, "gaps": (6,)}, [0] * 11),
        ([0.0] + [20.0] * 10, {"t_ms": AROUND_A_MINUTE_MS, "lag_ms": 100_000}, [0] + [1] * 10),
        ([np.nan] * 9, {}, [0] * 9),
        ([20.0] * 3 + [np.nan] * 2 + [20.0] * 4 + [np.nan] * 9, {}, [1] * 18),
    ],
    ids=[
        "no look-ahead", "4 ms of look-ahead", "a long look-ahead", "between the thresholds",
        "a touch of 8 ms", "a touch of 10 ms", "a short lift", "a gap", "no gap",
        "no force", "a begin under load, then no force",
    ],
)  # fmt: skip
def test_contact_is_as_worked_out_by_hand(
    grf_n: list[float], options: dict[str, Any], contact: list[int]
) -> None:
    assert detect_contact(grf_n, **{"lag_ms": 100} | options) == contact
