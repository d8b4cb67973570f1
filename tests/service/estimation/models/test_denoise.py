"""`denoise`: noise averaged away over as long as nothing happens, and nothing else."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.estimation.models.denoise import (
    AGREEMENT_SIGMAS,
    WINDOW_REACHES,
    WINDOW_READINGS_MAX,
    estimate_smoothing_errors,
)
from service.estimation.pipeline.smoothing_stage import TILE_FORCE
from service.estimation.tare.unloaded_windows import compute_variance_inflation
from tests.builders.averages import denoised

SIGMA_N, PERIOD_NS = 0.3, 1_838_235


def averaged(
    values: Any,
    *,
    look_ms: float = 10.0,
    t_ns: Any = None,
    run: Any = None,
    sigma_n: float = SIGMA_N,
    at_ns: Any = None,
    noise_left: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Values, and what is left of the noise's variance."""
    values = np.asarray(values, dtype=float)
    n = len(values)
    frame_ns = PERIOD_NS * np.arange(n) if t_ns is None else np.asarray(t_ns)
    out, left, *_ = denoised(
        values[:, None],
        np.full((n, 1), sigma_n),
        frame_ns[:, None].copy(),
        frame_ns,
        (frame_ns if at_ns is None else np.asarray(at_ns))[:, None].copy(),
        np.zeros(n, dtype=np.int64) if run is None else np.asarray(run),
        round(look_ms * 1e6),
        np.ones((1, WINDOW_READINGS_MAX + 1)) if noise_left is None else noise_left[None, :],
    )
    return out[:, 0], left[:, 0]


def noise(n: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(0.0, SIGMA_N, n)


COURSES = {
    "constant": lambda t: 0 * t + 31.7,
    "ramp": lambda t: 5.0 + 40.0 * t,
    "parabola": lambda t: 30.0 - 20.0 * t + 35.0 * t**2,
}


@pytest.mark.parametrize("look_ms", [0, 10, 100])
@pytest.mark.parametrize("course", ["constant", "ramp"])
def test_a_straight_course_without_noise_is_left_as_it_is(course: str, look_ms: float) -> None:
    values = COURSES[course](PERIOD_NS * 1e-9 * np.arange(300))
    out, left = averaged(values, look_ms=look_ms)
    assert out == pytest.approx(values, abs=1e-11)
    assert left[-1] < 0.1


@pytest.mark.parametrize("look_ms", [0, 10, 100])
@pytest.mark.parametrize("course", COURSES)
def test_on_a_straight_course_it_is_unbiased_and_in_a_bend_by_a_fraction_of_the_noise(
    course: str, look_ms: float
) -> None:
    # In a bend a long line is taken as soon as it agrees with all shorter windows.
    values = COURSES[course](PERIOD_NS * 1e-9 * np.arange(200))
    found = [averaged(values + noise(200, seed), look_ms=look_ms)[0] for seed in range(150)]
    off_n = np.array(found) - values
    standard_error_n = off_n.std(axis=0) / math.sqrt(150)
    in_bend_n = 0.2 * SIGMA_N if course == "parabola" else 0.0
    assert (np.abs(off_n.mean(axis=0)) < 4.5 * standard_error_n + in_bend_n).all()
    assert np.abs(off_n.mean()) < 0.004 + 0.6 * in_bend_n


@pytest.mark.parametrize("look_ms", [0, 10, 100])
def test_more_of_the_noise_is_averaged_away_than_it_says(look_ms: float) -> None:
    found = [averaged(30.0 + noise(200, seed), look_ms=look_ms) for seed in range(150)]
    off_n = np.array([out for out, _ in found])[:, 20:] - 30.0
    stated = np.array([left for _, left in found])[:, 20:]
    assert 0.6 < np.mean(off_n**2) / np.mean(SIGMA_N**2 * stated) < 1.0
    assert np.mean(off_n**2) < 0.25 * SIGMA_N**2
    assert (stated > 0.0).all()


def lasting_noise(n: int, part: float, readings: float, seed: int) -> np.ndarray:
    """White, and beside it what decays over so many readings; together as great as `noise`."""
    rng = np.random.default_rng(seed)
    phi = math.exp(-1.0 / readings)
    lasts = np.empty(n)
    lasts[0] = rng.normal()
    for i in range(1, n):
        lasts[i] = phi * lasts[i - 1] + math.sqrt(1.0 - phi**2) * rng.normal()
    return SIGMA_N * (math.sqrt(part) * lasts + math.sqrt(1.0 - part) * rng.normal(size=n))


@pytest.mark.parametrize("look_ms", [0, 10, 100])
@pytest.mark.parametrize(("part", "readings"), [(1.0, 5.5), (0.5, 5.5), (0.3, 30.0), (1.0, 1.0)])
def test_what_lasts_of_the_noise_is_not_averaged_away_and_it_says_so(
    look_ms: float, part: float, readings: float
) -> None:
    counts = np.maximum(np.arange(WINDOW_READINGS_MAX + 1), 1)
    lasting = compute_variance_inflation(np.array([part]), np.array([readings]), counts)

    def of_what_it_says(noise_left: np.ndarray | None) -> float:
        found = [averaged(c, look_ms=look_ms, noise_left=noise_left) for c in courses]
        off_n, stated = (np.array(each)[:, 20:] for each in zip(*found, strict=True))
        return float(np.mean((off_n - 30.0) ** 2) / np.mean(SIGMA_N**2 * stated))

    courses = [30.0 + lasting_noise(200, part, readings, seed) for seed in range(150)]
    assert 0.55 < of_what_it_says(lasting) < 1.1  # without look-ahead sigma is up to 4 % too small
    assert of_what_it_says(None) > 1.05  # taken for white


@pytest.mark.parametrize("step_n", [8.0, -8.0, 60.0])
def test_nothing_of_a_step_shows_before_it_or_after_it(step_n: float) -> None:
    values = np.where(np.arange(200) < 100, 20.0, 20.0 + step_n)
    off_n = np.array([averaged(values + noise(200, seed))[0] for seed in range(60)]) - values
    assert np.abs(off_n).max() < 5.5 * SIGMA_N
    # A reading beside it may be taken for one of the other side, with a small part of its weight.
    assert np.abs(off_n.mean(axis=0)).max() < SIGMA_N


def test_beside_a_step_the_window_grows_on_the_side_away_from_it() -> None:
    # As far behind as ahead there would be seven readings before the step is reached.
    values = np.where(np.arange(200) < 100, 20.0, 0.0)
    off_n = np.array([averaged(values + noise(200, s), look_ms=100)[0][103] for s in range(150)])
    assert np.mean(off_n**2) < SIGMA_N**2 / 7


def test_chance_alone_seldom_ends_a_window() -> None:
    # If it never did, 0.01 would be left; windows compared with single readings left 0.18.
    off_n = np.array([averaged(30.0 + noise(400, s), look_ms=100)[0][200] for s in range(300)]) - 30
    assert np.mean(off_n**2) < 0.14 * SIGMA_N**2


def test_a_kink_is_not_rounded_by_more_than_the_noise() -> None:
    values = np.where(np.arange(200) < 100, 0.0, 3.0 * (np.arange(200) - 100))
    off_n = np.array([averaged(values + noise(200, seed))[0] for seed in range(60)]) - values
    assert np.abs(off_n.mean(axis=0)).max() < SIGMA_N


@given(
    breaks=st.sets(st.integers(1, 59), max_size=6),
    missing=st.sets(st.integers(0, 59), max_size=15),
    level_n=st.floats(-1e6, 1e6),
    seed=st.integers(0, 1000),
)
def test_windows_never_cross_a_gap_and_a_missing_value_counts_for_nothing(
    breaks: set[int], missing: set[int], level_n: float, seed: int
) -> None:
    run = np.cumsum([i in breaks for i in range(60)])
    values = noise(60, seed)
    values[list(missing)] = np.nan
    out, left = averaged(values, run=run)
    assert np.flatnonzero(np.isnan(out)).tolist() == sorted(missing)
    # Whatever the other runs hold, and wherever they are: they might not be there at all.
    for number in range(int(run[-1]) + 1):
        others = np.where(run == number, values, level_n)
        again, left_again = averaged(others, run=run)
        rows = run == number
        assert again[rows].tobytes() == out[rows].tobytes()
        assert left_again[rows].tobytes() == left[rows].tobytes()


def test_it_looks_ahead_no_further_than_it_may_and_back_a_quarter_of_a_second() -> None:
    values, other = np.zeros(400), np.zeros(400)
    other[200] = 0.01
    moved = np.flatnonzero(averaged(other)[0] != averaged(values)[0])
    # 10 ms are five frames of 1.84 ms, 250 ms are 136, of which 128 are the longest reach.
    assert moved.min() == 195
    assert 300 < moved.max() <= 200 + WINDOW_REACHES[-1]


def test_values_are_those_of_the_instants_asked_for() -> None:
    t_ns = PERIOD_NS * np.arange(50)
    values = 5.0 + 40.0e-9 * (t_ns + 700_000)  # sampled 0.7 ms late
    out, _ = averaged(values, t_ns=t_ns, at_ns=t_ns - 700_000)
    assert out[10:] == pytest.approx(5.0 + 40.0e-9 * t_ns[10:], abs=1e-11)


@pytest.mark.parametrize("apart_ns", [0, 1, 17])
def test_samples_crowded_at_two_instants_tell_no_parabola(apart_ns: int) -> None:
    # Ill-conditioned by ten digits; a curve through them would swing by newtons.
    t_ns = np.sort([apart_ns * i + 1_838_235 * (i % 2) for i in range(40)])
    values = 30.0 + noise(40)
    out, left = averaged(values, t_ns=t_ns)
    assert np.isfinite(out).all()
    assert np.abs(out - 30.0).max() < 4 * SIGMA_N
    assert (left > 0.0).all()


def test_without_noise_to_average_readings_are_taken_at_their_word() -> None:
    values = 30.0 + noise(60)
    out, left = averaged(values, sigma_n=0.0)
    assert out.tolist() == values.tolist()
    assert left.tolist() == [1.0] * 60


def test_a_reading_alone_is_as_uncertain_as_it_was() -> None:
    out, left = averaged([7.0])
    assert (out.tolist(), left.tolist()) == ([7.0], [1.0])


@given(
    t_ns=st.lists(st.sampled_from([0, 1, 1000, 2_000_000, 60 * 10**9]), min_size=1, max_size=60),
    seed=st.integers(0, 1000),
)
def test_any_instants_give_finite_values_among_the_readings(t_ns: list[int], seed: int) -> None:
    values = 30.0 + noise(len(t_ns), seed)
    out, left = averaged(values, t_ns=np.cumsum(t_ns))
    # Of a window of many, a little less: what it averages away is less than a reading's noise.
    assert np.abs(out - values).max() <= AGREEMENT_SIGMAS * SIGMA_N + 1e-9
    assert (left > 0.0).all()


def shared_bend(bend_n: np.ndarray, noise_n: np.ndarray) -> np.ndarray:
    """What of the bends of tiles, (n, tiles), is in all of them."""
    tiles = np.zeros(bend_n.shape, TILE_FORCE)
    tiles["window_difference_n"], tiles["window_difference_sigma_n"] = bend_n, noise_n
    for frame in tiles:
        estimate_smoothing_errors(frame)
    return tiles["smoothing_error_n"]


def test_what_windows_smooth_away_of_a_load_is_found_in_the_sum_of_its_tiles() -> None:
    # Two sigma are nothing in a tile alone, and four in the sum of four.
    noise_n = np.full((1, 4), SIGMA_N)
    alone = np.array([[2.0 * SIGMA_N, math.nan, math.nan, math.nan]])
    assert not shared_bend(alone, noise_n).any()
    shared = shared_bend(np.full((1, 4), 2.0 * SIGMA_N), noise_n)
    assert shared == pytest.approx(2.0 * SIGMA_N * math.sqrt(1.0 - 1.0 / 16.0))
    # To different sides it is noise, however many tiles there are.
    assert not shared_bend(np.array([[2.0, -2.0, 2.0, -2.0]]) * SIGMA_N, noise_n).any()
    gone = np.array([[2.0, math.nan, 2.0, 2.0]]) * SIGMA_N
    assert (shared_bend(gone, noise_n) == 0.0).tolist() == [[False, True, False, False]]


@pytest.mark.parametrize(("shakes_n", "own", "whole"), [(0.0, 0.95, 0.95), (0.45, 0.5, 0.7)])
def test_a_load_that_shakes_all_tiles_makes_their_sum_less_certain_and_a_still_one_does_not(
    shakes_n: float, own: float, whole: float
) -> None:
    n, tiles = 4000, 4
    t_ns = PERIOD_NS * np.arange(n)
    load_n = 6.0 + shakes_n * np.sin(2 * math.pi * 35.0 * 1e-9 * t_ns)
    rng = np.random.default_rng(3)
    sampled_ns = np.repeat(t_ns[:, None], tiles, axis=1)
    out, left, bend, of_bend = denoised(
        load_n[:, None] + rng.normal(0.0, SIGMA_N, (n, tiles)),
        np.full((n, tiles), SIGMA_N),
        sampled_ns,
        t_ns,
        sampled_ns,
        np.zeros(n, dtype=np.int64),
        100_000_000,
        np.ones((tiles, WINDOW_READINGS_MAX + 1)),
    )
    off_n = (out - load_n[:, None]).sum(axis=1)
    own_n2 = (SIGMA_N**2 * left).sum(axis=1)
    shared_n = shared_bend(bend, SIGMA_N * np.sqrt(of_bend)).sum(axis=1)
    actual_n = np.sqrt((off_n**2).mean())
    # Of a shake that a tile cannot tell from its noise half is stated with the sum, a quarter not.
    assert own < np.sqrt(own_n2.mean()) / actual_n < own + 0.15
    assert whole < np.sqrt((own_n2 + shared_n**2).mean()) / actual_n < 1.2
