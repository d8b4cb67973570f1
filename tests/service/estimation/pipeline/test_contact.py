"""Contact, against a slow and plain reading of the same rules."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.flags import CONTACT_UNKNOWN
from service.estimation.pipeline.contact import update_contact
from service.estimation.pipeline.params import FootParams
from service.estimation.pipeline.smoothing_stage import TileForce
from service.estimation.pipeline.state import ContactState, make_frame_buffer

ON_N, OFF_N, MIN_NS = 5.0, 3.0, 10_000_000
MS = 1_000_000


def detect_contact(
    force_n: list[float],
    t_ms: list[int],
    *,
    lag_ms: int = 100,
    gaps: tuple[int, ...] = (),
    on_share: float = 0.0,
    corrections_n: list[float] | None = None,
    bounds: tuple[int, ...] = (),
) -> list[int]:
    """Detect the contact of a recording on one tile, whose frames have the force of its reading."""
    n = len(force_n)
    params = FootParams.array(
        1,
        contact_on_n=ON_N,
        contact_off_n=OFF_N,
        contact_on_share=on_share,
        contact_off_share=0.5 * on_share,
        contact_min_ns=MIN_NS,
        lookahead_ns=lag_ms * MS,
    )
    buffer, state, forces = make_frame_buffer(n, 1), ContactState.array(1), TileForce.array(1)
    # A missing tile bears an unknown load: the known ones, none here, are a bound.
    buffer.t_mono_ns[:], buffer.contact_n[:] = np.array(t_ms) * MS, np.nan_to_num(force_n)
    buffer.rows["is_contact_bound"] = np.isnan(force_n)
    buffer.rows["after_contact_pause"][list(gaps)] = 1
    buffer.rows["is_contact_bound"][list(bounds)] = 1
    out = []
    for i in range(n):
        correction_n = 0.0 if corrections_n is None else corrections_n[i]
        forces["dome_n"], forces["correction_n"] = force_n[i] + correction_n, correction_n
        update_contact(params[0], state[0], buffer, i, n, forces)
        out.append(int(state["is_contact"][0]))
    return out


def detect_plainly(
    force_n: list[float], t_ms: list[int], lag_ms: int, gaps: tuple[int, ...]
) -> list[int]:
    """Detect contact by runs of one candidate, then by each frame's visible frames."""
    candidates: list[int] = []
    for each_n in force_n:
        before = candidates[-1] if candidates else CONTACT_UNKNOWN
        if each_n >= ON_N:
            candidates.append(1)
        elif each_n <= OFF_N or (before == CONTACT_UNKNOWN and not math.isnan(each_n)):
            candidates.append(0)
        else:
            candidates.append(before)
    changes = np.diff(candidates, prepend=-1) != 0
    run = np.cumsum([i in gaps or changes[i] for i in range(len(force_n))])
    contact, out = CONTACT_UNKNOWN, []
    for i, t in enumerate(t_ms):
        visible = [t_ms[j] for j in range(len(t_ms)) if run[j] == run[i] and t_ms[j] <= t + lag_ms]
        if (max(visible) - min(visible)) * MS >= MIN_NS:
            contact = candidates[i]
        out.append(contact)
    return out


FORCES = st.one_of(
    st.sampled_from([0.0, -10.0, 2.9, 3.0, 3.1, 4.0, 4.9, 5.0, 5.1, 40.0, np.nan]),
    st.floats(-10, 50),
)


@st.composite
def recordings(draw: st.DrawFn) -> tuple[list[float], list[int], tuple[int, ...]]:
    stretches = draw(st.lists(st.tuples(FORCES, st.integers(1, 8)), min_size=1, max_size=12))
    force_n = [force for force, repeated in stretches for _ in range(repeated)]
    n = len(force_n)
    steps = draw(st.lists(st.sampled_from([1, 2, 2, 2, 3, 5, 40]), min_size=n, max_size=n))
    gaps = draw(st.sets(st.integers(1, n - 1), max_size=2)) if n > 1 else set()
    return force_n, np.cumsum(steps).tolist(), tuple(gaps)


@settings(max_examples=200)
@given(recordings(), st.sampled_from([0, 2, 5, 10, 11, 20, 100]))
def test_contact_follows_its_rules(
    recording: tuple[list[float], list[int], tuple[int, ...]], lag_ms: int
) -> None:
    force_n, t_ms, gaps = recording
    contact = detect_contact(force_n, t_ms, lag_ms=lag_ms, gaps=gaps)
    assert contact == detect_plainly(force_n, t_ms, lag_ms, gaps)


def test_what_a_load_leaves_of_creep_does_not_hold_contact() -> None:
    # 100 N, then the dome gives back 8 N of creep for a second: corrected, they are no load.
    force_n = [100.0] * 50 + [8.0] * 100
    corrections_n = [0.0] * 50 + [-8.0] * 100
    t_ms = list(range(0, 300, 2))
    assert detect_contact(force_n, t_ms) == [1] * 150
    assert detect_contact(force_n, t_ms, corrections_n=corrections_n) == [1] * 50 + [0] * 100


@pytest.mark.parametrize(("rest_n", "is_contact"), [(9.0, 1), (5.1, 1), (4.9, 0), (0.0, 0)])
def test_a_share_of_a_load_is_none(rest_n: float, is_contact: int) -> None:
    # 5 % of 100 N
    force_n = [100.0] * 50 + [rest_n] * 50
    contact = detect_contact(force_n, list(range(0, 200, 2)), on_share=0.1)
    assert contact == [1] * 50 + [is_contact] * 50


def test_a_load_is_forgotten() -> None:
    force_n = [100.0] * 10 + [0.0] * 10 + [9.0] * 10
    t_ms = list(range(0, 60, 2))
    assert detect_contact(force_n, t_ms, on_share=0.1)[20:] == [0] * 10
    later_ms = [t + 10_000 * (i >= 20) for i, t in enumerate(t_ms)]
    assert detect_contact(force_n, later_ms, on_share=0.1)[20:] == [1] * 10


def test_tiles_beside_a_missing_one_prove_contact_and_never_its_absence() -> None:
    force_n, t_ms = [40.0] * 10 + [0.0] * 10, list(range(0, 40, 2))
    assert detect_contact(force_n, t_ms) == [1] * 10 + [0] * 10
    assert detect_contact(force_n, t_ms, bounds=tuple(range(20))) == [1] * 20
    assert detect_contact(force_n, t_ms, bounds=tuple(range(10))) == [1] * 10 + [0] * 10


def test_contact_is_unknown_until_it_was_decided() -> None:
    t_ms = list(range(0, 40, 2))
    for force_n, is_contact in ((40.0, 1), (0.0, 0)):
        contact = detect_contact([force_n] * 20, t_ms, lag_ms=0)
        assert contact == [CONTACT_UNKNOWN] * 5 + [is_contact] * 15
        assert detect_contact([force_n] * 20, t_ms, lag_ms=10) == [is_contact] * 20
    assert detect_contact([math.nan] * 20, t_ms) == [CONTACT_UNKNOWN] * 20
