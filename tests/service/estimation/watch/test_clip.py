"""An edge at the top of loadings: where it is found, and where there is none."""

from __future__ import annotations

import numpy as np
import pytest

from devices.arrays import Bools, Floats, Times
from devices.compiled import compiled
from service.estimation.records import Records
from service.estimation.watch.clip import at_rest, end_of_range

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


def ends(kpa: Floats, is_taken: Bools | None = None) -> Floats:
    """After each reading; `is_taken`: but for those of frames that are lost."""
    t_ns = np.round(1e9 / RATE_HZ * np.arange(1, len(kpa) + 1)).astype(np.int64)
    taken = np.full(len(kpa), True) if is_taken is None else is_taken
    out = np.empty(np.count_nonzero(taken))
    _judge(at_rest(1), t_ns[taken], kpa[taken], out)
    return out


@compiled
def _judge(state: Records, t_ns: Times, kpa: Floats, out: Floats) -> None:
    for i in range(len(kpa)):
        out[i] = end_of_range(state[0], kpa[i], t_ns[i], 100.0, 4.0 * NOISE_KPA, NOISE_KPA)


def noise(n: int, seed: int = 1) -> Floats:
    return NOISE_KPA * np.random.default_rng(seed).standard_normal(n)


@pytest.mark.parametrize("where", ["behind it", "before it"])
def test_a_clip_is_found_within_a_dozen_steps_wherever_the_noise_is(where: str) -> None:
    whole = steps(30, scatter=0.12)
    n = len(whole)
    clipped = (
        np.minimum(whole + noise(n), CLIP_KPA)
        if where == "before it"
        else np.minimum(whole, CLIP_KPA) + noise(n)
    )
    end_kpa = ends(clipped)
    first = int(np.flatnonzero(np.isfinite(end_kpa))[0])
    assert first < 12 * 1.2 * RATE_HZ
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


@pytest.mark.parametrize(("share", "at_a_time"), [(0.1, 1), (0.1, 9), (0.1, 90), (0.1, 900)])
def test_frames_that_are_lost_make_the_same_load_no_edge(share: float, at_a_time: int) -> None:
    # As a plate that rolls over a foot, taken by a machine that is busy: a demo of ten minutes.
    whole = np.minimum(steps(1000, scatter=0.0), 107.0)
    begins = np.random.default_rng(7).random(len(whole)) < share / at_a_time
    lost = np.convolve(begins, np.ones(at_a_time))[: len(whole)] > 0
    assert 0.5 * share < lost.mean() < 1.5 * share
    assert np.isinf(ends(whole + noise(len(whole)), ~lost)).all()


def test_a_clip_is_found_at_90_frames_a_second() -> None:
    whole = np.minimum(steps(30, scatter=0.12), CLIP_KPA)
    every_fifth = np.arange(len(whole)) % 5 == 0
    assert np.isfinite(ends(whole + noise(len(whole)), every_fifth)[-1])


def test_a_clip_is_found_where_a_frame_in_ten_is_lost() -> None:
    whole = np.minimum(steps(30, scatter=0.12), CLIP_KPA)
    taken = np.random.default_rng(8).random(len(whole)) > 0.1
    assert np.isfinite(ends(whole + noise(len(whole)), taken)[-1])


def test_an_edge_that_is_exceeded_was_none() -> None:
    whole = steps(40, scatter=0.05)
    clipped = np.minimum(whole, CLIP_KPA)
    begin = len(whole) // 2
    clipped[begin:] = whole[begin:]
    end_kpa = ends(clipped + noise(len(whole)))
    assert np.isfinite(end_kpa[begin])
    assert np.isinf(end_kpa[begin + round(1.3 * RATE_HZ) :]).all()


def test_a_foot_that_stands_still_has_no_edge() -> None:
    kpa = np.where(np.arange(40_000) < 1000, 100.0, 108.0) + noise(40_000)
    assert np.isinf(ends(kpa)).all()
