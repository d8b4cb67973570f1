"""Contact, against a slow and plain reading of the same rules."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from service.estimation.foot import ContactState, is_debounced, update_candidate

ON_N, OFF_N, MIN_NS = 5.0, 3.0, 10_000_000
MS = 1_000_000


def detect_contact(
    grf_n: list[float], t_ms: list[int], lag_ms: int, gaps: tuple[int, ...]
) -> list[int]:
    """Detect the contact of a recording."""
    n = len(grf_n)
    t_ns = np.array(t_ms, dtype=np.int64) * MS
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
    contact = detect_contact(grf_n, t_ms, lag_ms, gaps)
    assert contact == detect_plainly(grf_n, t_ms, lag_ms, gaps)
