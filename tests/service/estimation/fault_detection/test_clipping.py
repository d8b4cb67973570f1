"""An edge at the top of loadings: where it is found, and where there is none."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from scipy.signal import lfilter

from devices.arrays import Bools, Floats, Times
from devices.jit import jit_cached
from service.estimation.fault_detection.clipping import (
    initial_clipping_state,
    update_clipping_limit_kpa,
)
from service.estimation.records import Records

RATE_HZ = 447.0
NOISE_KPA = 0.165
CLIP_KPA = 108.0


def steps(count: int, *, scatter: float, top_kpa: float = 11.0, seed: int = 0) -> Floats:
    """Absolute pressure of half sines of 0.6 s with as long between them."""
    rng = np.random.default_rng(seed)
    t_s = np.arange(round(1.2 * RATE_HZ)) / RATE_HZ
    shape = np.where(t_s < 0.6, np.sin(np.pi * np.minimum(t_s, 0.6) / 0.6), 0.0)
    return np.concatenate(
        [100.0 + top_kpa * (1.0 + scatter * rng.standard_normal()) * shape for _ in range(count)]
    )


def judged(
    kpa: Floats,
    is_taken: Bools | None = None,
    *,
    others_kpa: Floats | float = 0.0,
    noise_left: float = 1.0,
) -> tuple[Floats, Floats]:
    """Return end of the range and evidence after each reading; `is_taken`: of those not lost."""
    t_ns = np.round(1e9 / RATE_HZ * np.arange(1, len(kpa) + 1)).astype(np.int64)
    taken = np.full(len(kpa), True) if is_taken is None else is_taken
    end_kpa, evidence = np.empty((2, np.count_nonzero(taken)))
    others = np.broadcast_to(others_kpa, kpa.shape)[taken]
    _judge(
        initial_clipping_state(1), t_ns[taken], kpa[taken], others, noise_left, end_kpa, evidence
    )
    return end_kpa, evidence


def ends(kpa: Floats, is_taken: Bools | None = None, *, others_kpa: Floats | float = 0.0) -> Floats:
    """Return the end of the range after each reading."""
    return judged(kpa, is_taken, others_kpa=others_kpa)[0]


@jit_cached
def _judge(
    state: Records,
    t_ns: Times,
    kpa: Floats,
    others: Floats,
    noise_left: float,
    end_kpa: Floats,
    evidence: Floats,
) -> None:
    for i in range(len(kpa)):
        end_kpa[i] = update_clipping_limit_kpa(
            state[0], kpa[i], t_ns[i], 100.0, 4.0 * NOISE_KPA, NOISE_KPA, noise_left, others[i]
        )
        evidence[i] = state[0].evidence


def noise(n: int, seed: int = 1) -> Floats:
    return NOISE_KPA * np.random.default_rng(seed).standard_normal(n)


@pytest.mark.parametrize("where", ["behind it", "before it"])
def test_a_clip_of_a_lone_tile_is_found_within_thirty_steps_wherever_the_noise_is(
    where: str,
) -> None:
    whole = steps(30, scatter=0.12)
    n = len(whole)
    clipped = (
        np.minimum(whole + noise(n), CLIP_KPA)
        if where == "before it"
        else np.minimum(whole, CLIP_KPA) + noise(n)
    )
    end_kpa = ends(clipped)
    first = int(np.flatnonzero(np.isfinite(end_kpa))[0])
    assert np.isfinite(end_kpa[first:]).all()
    assert CLIP_KPA - 5 * NOISE_KPA < end_kpa[-1] < CLIP_KPA - 2 * NOISE_KPA


@pytest.mark.parametrize("scatter", [0.0, 0.01, 0.05])
def test_a_thousand_healthy_steps_have_no_edge_however_alike_they_are(scatter: float) -> None:
    whole = steps(1000, scatter=scatter)
    assert np.isinf(ends(whole + noise(len(whole)))).all()


def test_a_thousand_steps_with_flat_tops_that_differ_have_no_edge() -> None:
    # Of 3 %, as loadings of real domes do (paper III-A).
    whole = np.minimum(steps(1000, scatter=0.0), 107.0)
    lap = np.arange(len(whole)) // round(1.2 * RATE_HZ)
    gains = 1.0 + 0.03 * np.random.default_rng(3).standard_normal(lap[-1] + 1)
    assert np.isinf(ends(100.0 + (whole - 100.0) * gains[lap] + noise(len(whole)))).all()


def test_the_same_load_again_and_again_has_no_edge_even_if_its_top_is_flat() -> None:
    whole = np.minimum(steps(1000, scatter=0.0), 107.0)
    assert np.isinf(ends(whole + noise(len(whole)))).all()


def flat(stays_s: Sequence[float]) -> Floats:
    """Return absolute pressure of loads with one flat top, as of a robot with so many footholds."""
    t_s = np.arange(0.0, 1.2, 1 / RATE_HZ)
    return 100.0 + np.concatenate(
        [np.interp(t_s, [0, 0.1, 0.1 + s, 0.2 + s], [0, 7, 7, 0]) for s in stays_s]
    )


def lose(n: int, share: float, at_a_time: int) -> Bools:
    """Return which of so many frames are lost, by a machine that is busy elsewhere."""
    begins = np.random.default_rng(7).random(n) < share / at_a_time
    return np.asarray(np.convolve(begins, np.ones(at_a_time))[:n] > 0)


@pytest.mark.parametrize("loads", [1, 2, 3])
@pytest.mark.parametrize(
    ("share", "at_a_time"), [(0.0, 1), (0.02, 1), (0.02, 50), (0.1, 1), (0.1, 9), (0.1, 50)]
)
def test_loads_that_repeat_have_bounded_evidence_whatever_is_lost(
    loads: int, share: float, at_a_time: int
) -> None:
    whole = np.tile(flat(np.linspace(0.3, 0.6, loads).tolist()), 3000 // loads)  # an hour
    kpa = whole + noise(len(whole))
    lost = lose(len(kpa), share, at_a_time)
    end_kpa, evidence = judged(kpa, ~lost)
    assert np.isinf(end_kpa).all()
    assert evidence.max() < 2.5 * (loads + 1)


def test_noise_that_lasts_does_not_make_a_load_differ_from_itself() -> None:
    whole = np.tile(flat([0.4]), 3000)
    keeps = np.exp(-1.0 / (0.01 * RATE_HZ))  # from reading to reading: for 10 ms
    lasting = lfilter([np.sqrt(1.0 - keeps**2)], [1.0, -keeps], noise(len(whole)))
    end_kpa, evidence = judged(whole + lasting, noise_left=(1.0 + keeps) / (1.0 - keeps))
    assert np.isinf(end_kpa).all()
    assert evidence.max() < 5.0


def test_an_outlier_does_not_part_a_load_in_two() -> None:
    # A weight is put on, with a reading of nothing now and then; taken off once a minute.
    n = round(60.0 * RATE_HZ)
    held = np.full(n, 107.0)
    held[: n // 60] = 100.0
    kpa = np.tile(held, 20) + noise(20 * n)
    kpa[np.random.default_rng(9).random(len(kpa)) < 0.5 / RATE_HZ] = 100.0
    end_kpa, evidence = judged(kpa)
    assert np.isinf(end_kpa).all()
    assert evidence.max() < 5.0


@pytest.mark.parametrize(("share", "at_a_time"), [(0.1, 1), (0.1, 9), (0.1, 90), (0.1, 900)])
def test_frames_that_are_lost_make_the_same_load_no_edge(share: float, at_a_time: int) -> None:
    # As a plate that rolls over a foot, taken by a machine that is busy: a demo of ten minutes.
    whole = np.minimum(steps(1000, scatter=0.0), 107.0)
    lost = lose(len(whole), share, at_a_time)
    assert 0.5 * share < lost.mean() < 1.5 * share
    assert np.isinf(ends(whole + noise(len(whole)), ~lost)).all()


def test_a_clip_is_found_sooner_beside_other_tiles_even_at_90_frames_a_second() -> None:
    whole = np.minimum(steps(20, scatter=0.12), CLIP_KPA)
    others_kpa = steps(20, scatter=0.12, seed=5) - 100.0 + noise(len(whole), seed=6)
    every_fifth = np.arange(len(whole)) % 5 == 0
    end_kpa = ends(whole + noise(len(whole)), every_fifth, others_kpa=others_kpa)
    assert np.isfinite(end_kpa[-1])


def test_a_clip_is_found_where_a_frame_in_ten_is_lost() -> None:
    whole = np.minimum(steps(30, scatter=0.12), CLIP_KPA)
    taken = np.random.default_rng(8).random(len(whole)) > 0.1
    assert np.isfinite(ends(whole + noise(len(whole)), taken)[-1])


def test_an_edge_that_is_exceeded_was_none() -> None:
    whole = steps(60, scatter=0.12)
    clipped = np.minimum(whole, CLIP_KPA)
    begin = len(whole) // 2
    clipped[begin:] = whole[begin:]
    end_kpa = ends(clipped + noise(len(whole)))
    assert np.isfinite(end_kpa[begin])
    assert np.isinf(end_kpa[begin + round(1.3 * RATE_HZ) :]).all()


def test_a_foot_that_stands_still_has_no_edge() -> None:
    kpa = np.where(np.arange(40_000) < 1000, 100.0, 108.0) + noise(40_000)
    assert np.isinf(ends(kpa)).all()
