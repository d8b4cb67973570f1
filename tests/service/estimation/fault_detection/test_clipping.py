"""Clipping: an edge at the top of loadings."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from devices.arrays import Bools, Floats, Times
from devices.jit import jit_cached
from service.estimation.fault_detection.clipping import (
    ClippingState,
    update_clipping_limit_kpa,
)
from service.estimation.records import RecordArray
from tests.builders.noise import draw_lasting_noise

RATE_HZ = 447.0
NOISE_KPA = 0.165
CLIP_KPA = 108.0


def draw_steps(count: int, *, scatter: float, seed: int = 0) -> Floats:
    """Draw absolute pressures of half sines of 11 kPa and 0.6 s with as long between them."""
    rng = np.random.default_rng(seed)
    t_s = np.arange(round(1.2 * RATE_HZ)) / RATE_HZ
    shape = np.where(t_s < 0.6, np.sin(np.pi * np.minimum(t_s, 0.6) / 0.6), 0.0)
    return np.concatenate(
        [100.0 + 11.0 * (1.0 + scatter * rng.standard_normal()) * shape for _ in range(count)]
    )


def follow(
    kpa: Floats,
    is_taken: Bools | None = None,
    *,
    others_kpa: Floats | float = 0.0,
    noise_left: float = 1.0,
) -> tuple[Floats, Floats]:
    """Return end of the range and evidence after each reading that is taken."""
    t_ns = np.round(1e9 / RATE_HZ * np.arange(1, len(kpa) + 1)).astype(np.int64)
    taken = np.full(len(kpa), True) if is_taken is None else is_taken
    end_kpa, evidence = np.empty((2, np.count_nonzero(taken)))
    others = np.broadcast_to(others_kpa, kpa.shape)[taken]
    _update_all(
        ClippingState.array(1), t_ns[taken], kpa[taken], others, noise_left, end_kpa, evidence
    )
    return end_kpa, evidence


@jit_cached
def _update_all(
    state: RecordArray[ClippingState],
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


def draw_noise(n: int, seed: int = 1) -> Floats:
    return NOISE_KPA * np.random.default_rng(seed).standard_normal(n)


@pytest.mark.parametrize("noise", ["after the clip", "before the clip"])
def test_a_clip_is_found_within_thirty_steps(
    noise: str,
) -> None:
    whole = draw_steps(30, scatter=0.12)
    n = len(whole)
    clipped = (
        np.minimum(whole + draw_noise(n), CLIP_KPA)
        if noise == "before the clip"
        else np.minimum(whole, CLIP_KPA) + draw_noise(n)
    )
    end_kpa, _ = follow(clipped)
    first = int(np.flatnonzero(np.isfinite(end_kpa))[0])
    assert np.isfinite(end_kpa[first:]).all()
    assert CLIP_KPA - 5 * NOISE_KPA < end_kpa[-1] < CLIP_KPA - 2 * NOISE_KPA


@pytest.mark.parametrize(
    ("scatter", "top_kpa", "gain_scatter"),
    [
        (0.0, np.inf, 0.0),
        (0.01, np.inf, 0.0),
        (0.05, np.inf, 0.0),
        (0.0, 107.0, 0.0),
        # Of 3 %, as loadings of real domes do (paper III-A).
        (0.0, 107.0, 0.03),
    ],
    ids=["equal", "1 % apart", "5 % apart", "equal flat tops", "flat tops 3 % apart"],
)
def test_a_thousand_healthy_steps_have_no_edge(
    scatter: float, top_kpa: float, gain_scatter: float
) -> None:
    whole = np.minimum(draw_steps(1000, scatter=scatter), top_kpa)
    lap = np.arange(len(whole)) // round(1.2 * RATE_HZ)
    gains = 1.0 + gain_scatter * np.random.default_rng(3).standard_normal(lap[-1] + 1)
    kpa = 100.0 + (whole - 100.0) * gains[lap] + draw_noise(len(whole))
    assert np.isinf(follow(kpa)[0]).all()


def make_flat_loads(stays_s: Sequence[float]) -> Floats:
    """Make absolute pressures of loads with one flat top, as of a robot with so many footholds."""
    t_s = np.arange(0.0, 1.2, 1 / RATE_HZ)
    return 100.0 + np.concatenate(
        [np.interp(t_s, [0, 0.1, 0.1 + s, 0.2 + s], [0, 7, 7, 0]) for s in stays_s]
    )


def draw_lost(n: int, share: float, at_a_time: int) -> Bools:
    """Draw frames that a busy machine loses, so many at a time."""
    begins = np.random.default_rng(7).random(n) < share / at_a_time
    return np.asarray(np.convolve(begins, np.ones(at_a_time))[:n] > 0)


@pytest.mark.parametrize("loads", [1, 2, 3])
@pytest.mark.parametrize(("share", "at_a_time"), [(0.0, 1), (0.02, 1), (0.1, 9), (0.1, 50)])
def test_repeating_loads_have_bounded_evidence_with_lost_frames(
    loads: int, share: float, at_a_time: int
) -> None:
    whole = np.tile(
        make_flat_loads(np.linspace(0.3, 0.6, loads).tolist()), 3000 // loads
    )  # an hour
    kpa = whole + draw_noise(len(whole))
    lost = draw_lost(len(kpa), share, at_a_time)
    end_kpa, evidence = follow(kpa, ~lost)
    assert np.isinf(end_kpa).all()
    assert evidence.max() < 2.5 * (loads + 1)


def test_lasting_noise_adds_no_evidence() -> None:
    whole, readings = np.tile(make_flat_loads([0.4]), 3000), 0.01 * RATE_HZ
    lasting = draw_lasting_noise(len(whole), 1, part=1.0, readings=readings)[:, 0]
    keeps = np.exp(-1.0 / readings)
    kpa = whole + NOISE_KPA * lasting
    end_kpa, evidence = follow(kpa, noise_left=(1.0 + keeps) / (1.0 - keeps))
    assert np.isinf(end_kpa).all()
    assert evidence.max() < 5.0


def test_outliers_do_not_split_a_load() -> None:
    # A weight is put on, with a reading of nothing now and then; taken off once a minute.
    n = round(60.0 * RATE_HZ)
    minute = np.full(n, 107.0)
    minute[: n // 60] = 100.0
    kpa = np.tile(minute, 20) + draw_noise(20 * n)
    kpa[np.random.default_rng(9).random(len(kpa)) < 0.5 / RATE_HZ] = 100.0
    end_kpa, evidence = follow(kpa)
    assert np.isinf(end_kpa).all()
    assert evidence.max() < 5.0


@pytest.mark.parametrize(("share", "at_a_time"), [(0.1, 1), (0.1, 9), (0.1, 900)])
def test_lost_frames_make_no_edge(share: float, at_a_time: int) -> None:
    # As a plate that rolls over a foot, taken by a machine that is busy: a demo of ten minutes.
    whole = np.minimum(draw_steps(1000, scatter=0.0), 107.0)
    lost = draw_lost(len(whole), share, at_a_time)
    assert 0.5 * share < lost.mean() < 1.5 * share
    assert np.isinf(follow(whole + draw_noise(len(whole)), ~lost)[0]).all()


def test_a_clip_is_found_sooner_beside_other_tiles() -> None:
    whole = np.minimum(draw_steps(20, scatter=0.12), CLIP_KPA)
    others_kpa = draw_steps(20, scatter=0.12, seed=5) - 100.0 + draw_noise(len(whole), seed=6)
    every_fifth = np.arange(len(whole)) % 5 == 0
    end_kpa, _ = follow(whole + draw_noise(len(whole)), every_fifth, others_kpa=others_kpa)
    assert np.isfinite(end_kpa[-1])


def test_a_clip_is_found_with_a_tenth_of_frames_lost() -> None:
    whole = np.minimum(draw_steps(30, scatter=0.12), CLIP_KPA)
    taken = np.random.default_rng(8).random(len(whole)) > 0.1
    assert np.isfinite(follow(whole + draw_noise(len(whole)), taken)[0][-1])


def test_an_exceeded_edge_is_given_up() -> None:
    whole = draw_steps(60, scatter=0.12)
    clipped = np.minimum(whole, CLIP_KPA)
    begin = len(whole) // 2
    clipped[begin:] = whole[begin:]
    end_kpa, _ = follow(clipped + draw_noise(len(whole)))
    assert np.isfinite(end_kpa[begin])
    assert np.isinf(end_kpa[begin + round(1.3 * RATE_HZ) :]).all()


def test_a_constant_load_has_no_edge() -> None:
    kpa = np.where(np.arange(40_000) < 1000, 100.0, 108.0) + draw_noise(40_000)
    assert np.isinf(follow(kpa)[0]).all()
