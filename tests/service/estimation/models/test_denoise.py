"""`denoise`: averages over windows in which a force does not change, and outliers of pressure."""

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
    find_outliers,
)
from service.estimation.pipeline.smoothing_stage import TILE_FORCE
from service.estimation.tare.unloaded_windows import compute_variance_inflation
from tests.builders.averages import denoised
from tests.builders.noise import draw_lasting_noise

SIGMA_N, PERIOD_NS = 0.3, 1_838_235
COURSES_N = {
    "constant": lambda t: 0 * t + 31.7,
    "ramp": lambda t: 5.0 + 40.0 * t,
    "parabola": lambda t: 30.0 - 20.0 * t + 35.0 * t**2,
}
each_look_ahead = pytest.mark.parametrize("look_ms", [0, 10, 100])


def average(
    values: Any,
    *,
    look_ms: float = 10.0,
    t_ns: Any = None,
    run: Any = None,
    sigma_n: float = SIGMA_N,
    at_ns: Any = None,
    inflation: np.ndarray | None = None,
) -> tuple[np.ndarray, ...]:
    """Average columns; return them, their part of the variance, and bends with their variance."""
    values = np.asarray(values, dtype=float)
    n = len(values)
    columns = np.ascontiguousarray(values.reshape(n, -1))
    tiles = columns.shape[1]
    frame_ns = PERIOD_NS * np.arange(n) if t_ns is None else np.asarray(t_ns)
    sampled_ns, asked_ns = (
        np.repeat(np.asarray(each)[:, None], tiles, axis=1)
        for each in (frame_ns, frame_ns if at_ns is None else at_ns)
    )
    found = denoised(
        columns,
        np.full((n, tiles), sigma_n),
        sampled_ns,
        frame_ns,
        asked_ns,
        np.zeros(n, dtype=np.int64) if run is None else np.asarray(run),
        round(look_ms * 1e6),
        np.tile(np.ones(WINDOW_READINGS_MAX + 1) if inflation is None else inflation, (tiles, 1)),
    )
    return tuple(column.reshape(values.shape) for column in found)


def draw_noise(n: int, tiles: int = 0, seed: int = 0) -> np.ndarray:
    """Draw noise (n, tiles), or (n,) without `tiles`."""
    columns = range(seed, seed + max(tiles, 1))
    noise_n = [np.random.default_rng(column).normal(0.0, SIGMA_N, n) for column in columns]
    return np.stack(noise_n, axis=1) if tiles else noise_n[0]


@each_look_ahead
@pytest.mark.parametrize("course", ["constant", "ramp"])
def test_a_straight_course_without_noise_stays(course: str, look_ms: float) -> None:
    values = COURSES_N[course](PERIOD_NS * 1e-9 * np.arange(300))
    out, left, *_ = average(values, look_ms=look_ms)
    assert out == pytest.approx(values, abs=1e-11)
    assert left[-1] < 0.1


@each_look_ahead
@pytest.mark.parametrize("course", COURSES_N)
def test_averages_have_no_bias_but_a_fraction_of_the_noise_in_a_bend(
    course: str, look_ms: float
) -> None:
    # In a bend a long line is taken as soon as it agrees with all shorter windows.
    values = COURSES_N[course](PERIOD_NS * 1e-9 * np.arange(200))[:, None]
    off_n = average(values + draw_noise(200, 150), look_ms=look_ms)[0] - values
    standard_error_n = off_n.std(axis=1) / math.sqrt(150)
    in_bend_n = 0.2 * SIGMA_N if course == "parabola" else 0.0
    assert (np.abs(off_n.mean(axis=1)) < 4.5 * standard_error_n + in_bend_n).all()
    assert np.abs(off_n.mean()) < 0.004 + 0.6 * in_bend_n


@each_look_ahead
@pytest.mark.parametrize(
    ("part", "readings"), [(0.0, 1.0), (1.0, 5.5), (0.5, 5.5), (0.3, 30.0), (1.0, 1.0)]
)
def test_the_stated_sigma_holds_for_white_and_for_lasting_noise(
    look_ms: float, part: float, readings: float
) -> None:
    counts = np.maximum(np.arange(WINDOW_READINGS_MAX + 1), 1)
    lasting = compute_variance_inflation(np.array([part]), np.array([readings]), counts)
    noise_n = SIGMA_N * draw_lasting_noise(200, 600, part=part, readings=readings)

    def compare_variance(inflation: np.ndarray | None) -> float:
        out, left, *_ = average(30.0 + noise_n, look_ms=look_ms, inflation=inflation)
        return float(np.mean((out[20:] - 30.0) ** 2) / np.mean(SIGMA_N**2 * left[20:]))

    # Without look-ahead sigma is a few percent too small.
    assert 0.55 < compare_variance(lasting) < (1.15 if look_ms == 0 else 1.1)
    if part:
        assert compare_variance(None) > 1.05  # taken for white
    else:
        assert 0.6 < compare_variance(None) < 1.0
        out, left, *_ = average(30.0 + noise_n, look_ms=look_ms)
        assert np.mean((out[20:] - 30.0) ** 2) < 0.25 * SIGMA_N**2
        assert (left > 0.0).all()


@pytest.mark.parametrize("step_n", [8.0, -8.0, 60.0])
def test_a_step_stays_sharp(step_n: float) -> None:
    values = np.where(np.arange(200) < 100, 20.0, 20.0 + step_n)[:, None]
    off_n = average(values + draw_noise(200, 60))[0] - values
    assert np.abs(off_n).max() < 5.5 * SIGMA_N
    # A reading beside it may count on the other side, with a small part of its weight.
    assert np.abs(off_n.mean(axis=1)).max() < SIGMA_N


def test_a_window_beside_a_step_grows_away_from_it() -> None:
    # As many frames behind as ahead would be seven readings before the step.
    values = np.where(np.arange(200) < 100, 20.0, 0.0)[:, None]
    off_n = average(values + draw_noise(200, 150), look_ms=100)[0][103]
    assert np.mean(off_n**2) < SIGMA_N**2 / 7


def test_chance_seldom_ends_a_window() -> None:
    # If it never did, 0.01 would be left; windows compared with single readings left 0.18.
    off_n = average(30.0 + draw_noise(400, 300), look_ms=100)[0][200] - 30.0
    assert np.mean(off_n**2) < 0.14 * SIGMA_N**2


def test_a_kink_is_rounded_by_less_than_the_noise() -> None:
    values = np.where(np.arange(200) < 100, 0.0, 3.0 * (np.arange(200) - 100))[:, None]
    off_n = average(values + draw_noise(200, 60))[0] - values
    assert np.abs(off_n.mean(axis=1)).max() < SIGMA_N


@given(
    breaks=st.sets(st.integers(1, 59), max_size=6),
    missing=st.sets(st.integers(0, 59), max_size=15),
    level_n=st.floats(-1e6, 1e6),
    seed=st.integers(0, 1000),
)
def test_windows_use_neither_other_runs_nor_missing_values(
    breaks: set[int], missing: set[int], level_n: float, seed: int
) -> None:
    run = np.cumsum([i in breaks for i in range(60)])
    values = draw_noise(60, seed=seed)
    values[list(missing)] = np.nan
    out, left, *_ = average(values, run=run)
    assert np.flatnonzero(np.isnan(out)).tolist() == sorted(missing)
    for number in range(int(run[-1]) + 1):
        rows = run == number
        again, left_again, *_ = average(np.where(rows, values, level_n), run=run)
        assert again[rows].tobytes() == out[rows].tobytes()
        assert left_again[rows].tobytes() == left[rows].tobytes()


def test_windows_reach_to_the_look_ahead_and_a_quarter_of_a_second_back() -> None:
    values, other = np.zeros(400), np.zeros(400)
    other[200] = 0.01
    moved = np.flatnonzero(average(other)[0] != average(values)[0])
    # 10 ms are five frames of 1.84 ms, 250 ms are 136, of which 128 are the longest reach.
    assert moved.min() == 195
    assert 300 < moved.max() <= 200 + WINDOW_REACHES[-1]


def test_averages_are_of_the_requested_instants() -> None:
    t_ns = PERIOD_NS * np.arange(50)
    values = 5.0 + 40.0e-9 * (t_ns + 700_000)  # sampled 0.7 ms late
    out, *_ = average(values, t_ns=t_ns, at_ns=t_ns - 700_000)
    assert out[10:] == pytest.approx(5.0 + 40.0e-9 * t_ns[10:], abs=1e-11)


@pytest.mark.parametrize("early_ns", [-700_000, 700_000])
def test_readings_finer_than_any_curve_are_of_the_requested_instants(early_ns: int) -> None:
    """Noise hides no bend, so no window is accepted: the line to the neighbour is all there is."""
    t_ns = PERIOD_NS * np.arange(50)
    values = 5.0 + np.sin(3e-7 * t_ns)
    out, left, *_ = average(values, t_ns=t_ns, at_ns=t_ns - early_ns, sigma_n=1e-5)
    assert out[1:-10] == pytest.approx(np.interp(t_ns - early_ns, t_ns, values)[1:-10], abs=1e-12)
    assert (left == 1.0).all()


@pytest.mark.parametrize("apart_ns", [0, 1, 17])
def test_samples_at_two_crowded_instants_give_no_parabola(apart_ns: int) -> None:
    # Ill-conditioned by ten digits; a curve through them would swing by newtons.
    t_ns = np.sort([apart_ns * i + 1_838_235 * (i % 2) for i in range(40)])
    out, left, *_ = average(30.0 + draw_noise(40), t_ns=t_ns)
    assert np.abs(out - 30.0).max() < 4 * SIGMA_N
    assert (left > 0.0).all()


@pytest.mark.parametrize(("n", "sigma_n"), [(60, 0.0), (1, SIGMA_N)], ids=["no noise", "one"])
def test_readings_without_noise_or_alone_stay(n: int, sigma_n: float) -> None:
    values = 30.0 + draw_noise(n)
    out, left, *_ = average(values, sigma_n=sigma_n)
    assert (out.tolist(), left.tolist()) == (values.tolist(), [1.0] * n)


@given(
    t_ns=st.lists(st.sampled_from([0, 1, 1000, 2_000_000, 60 * 10**9]), min_size=1, max_size=60),
    seed=st.integers(0, 1000),
)
def test_averages_at_any_instants_lie_among_the_readings(t_ns: list[int], seed: int) -> None:
    values = 30.0 + draw_noise(len(t_ns), seed=seed)
    out, left, *_ = average(values, t_ns=np.cumsum(t_ns))
    assert np.abs(out - values).max() <= AGREEMENT_SIGMAS * SIGMA_N + 1e-9
    assert (left > 0.0).all()


# --- bends that tiles share -----------------------------------------------------------------------


def find_shared_bend(bend_n: np.ndarray, noise_n: Any) -> np.ndarray:
    """Find the part of bends of tiles (n, tiles) that all tiles share."""
    tiles = np.zeros(bend_n.shape, TILE_FORCE)
    tiles["window_difference_n"], tiles["window_difference_sigma_n"] = bend_n, noise_n
    for frame in tiles:
        estimate_smoothing_errors(frame)
    return tiles["smoothing_error_n"]


@pytest.mark.parametrize(
    ("bend_sigmas", "shared_sigmas"),
    [
        # Two sigma are nothing in a tile alone, and four in the sum of four.
        ([2.0, math.nan, math.nan, math.nan], [0.0] * 4),
        ([2.0] * 4, [2.0 * math.sqrt(1.0 - 1.0 / 16.0)] * 4),
        ([2.0, -2.0, 2.0, -2.0], [0.0] * 4),
        ([2.0, math.nan, 2.0, 2.0], [s := 2.0 * math.sqrt(1.0 - 1.0 / 12.0), 0.0, s, s]),
    ],
    ids=["one tile", "four tiles", "to different sides", "one of four missing"],
)
def test_a_smoothed_bend_is_found_in_the_sum_of_tiles(
    bend_sigmas: list[float], shared_sigmas: list[float]
) -> None:
    shared_n = find_shared_bend(SIGMA_N * np.array([bend_sigmas]), SIGMA_N)
    assert shared_n[0] == pytest.approx(SIGMA_N * np.array(shared_sigmas))


@pytest.mark.parametrize(("shakes_n", "own", "whole"), [(0.0, 0.95, 0.95), (0.45, 0.5, 0.7)])
def test_the_sum_of_tiles_is_less_certain_only_where_a_load_shakes(
    shakes_n: float, own: float, whole: float
) -> None:
    t_s = 1e-9 * PERIOD_NS * np.arange(4000)
    load_n = 6.0 + shakes_n * np.sin(2 * math.pi * 35.0 * t_s)[:, None]
    out, left, bend, of_bend = average(load_n + draw_noise(4000, 4, seed=3), look_ms=100)
    actual_n = np.sqrt(((out - load_n).sum(axis=1) ** 2).mean())
    own_n2 = (SIGMA_N**2 * left).sum(axis=1)
    shared_n = find_shared_bend(bend, SIGMA_N * np.sqrt(of_bend)).sum(axis=1)
    # Of a shake that a tile cannot tell from its noise half is stated with the sum, a quarter not.
    assert own < np.sqrt(own_n2.mean()) / actual_n < own + 0.15
    assert whole < np.sqrt((own_n2 + shared_n**2).mean()) / actual_n < 1.2


# --- outliers of pressure -------------------------------------------------------------------------

NOISE_KPA = 0.165


def find(kpa: Any) -> list[int]:
    column = np.array(kpa, dtype=float)[:, None]
    return np.flatnonzero(find_outliers(column, np.array([NOISE_KPA]))).tolist()


@pytest.mark.parametrize("off_kpa", [-30.0, -2.0, -0.7, 0.7, 10.0])
def test_a_reading_far_from_its_neighbours_is_an_outlier(off_kpa: float) -> None:
    assert find([100.0, 100.2, 100.3 + off_kpa, 100.4, 100.4]) == [2]


@pytest.mark.parametrize(
    "kpa",
    [
        [100.0, 100.0, 110.0, 110.0],
        [110.0, 110.0, 100.0, 100.0],
        [100.0, 105.0, 110.0, 115.0],
        [100.0, 100.3, 101.2, 102.7, 104.8],
        [100.0, 103.0, 104.5, 105.0, 104.5, 103.0],
        [100.0, 100.0, 95.0, 95.0, 100.0, 100.0],
        [90.0, 100.0, 100.0],
        [100.0, 100.0, 90.0],
        [90.0],
        [90.0, 100.0],
    ],
)
def test_steps_slopes_bends_pairs_and_ends_have_no_outlier(kpa: list[float]) -> None:
    assert find(kpa) == []


@pytest.mark.parametrize("invalid_kpa", [math.nan, math.inf, -math.inf])
def test_a_reading_beside_an_invalid_one_is_no_outlier(invalid_kpa: float) -> None:
    found = find([100.0, invalid_kpa, 90.0, 100.0, 90.0, invalid_kpa, 100.0])
    assert not {2, 4} & set(found)


@given(st.lists(st.floats(99.9, 100.1), min_size=3, max_size=30))
def test_small_noise_has_no_outlier(kpa: list[float]) -> None:
    assert find(kpa) == []


def test_white_noise_has_an_outlier_in_a_few_hundred_readings() -> None:
    kpa = np.random.default_rng(1).normal(100.0, NOISE_KPA, 100_000)
    assert 1 / 800 < len(find(kpa)) / 100_000 < 1 / 300
