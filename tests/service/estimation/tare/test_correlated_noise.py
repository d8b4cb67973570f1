"""Lasting noise of an unloaded tile, and the noise that it leaves in a mean."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.estimation.tare.unloaded_windows import (
    compute_variance_inflation,
    fit_correlated_variance_fraction_and_decay,
)
from tests.builders.noise import draw_lasting_noise


def draw_readings_kpa(
    n: int, tiles: int, *, part: float, readings: float, seed: int, count_kpa: float = 0.1
) -> np.ndarray:
    """Draw unloaded readings (n, tiles) in whole counts."""
    noise = draw_lasting_noise(n, tiles, part=part, readings=readings, seed=seed)
    return np.round((100.0 + 0.165 * noise) / count_kpa) * count_kpa


def inflate(part: float, readings: float, n: int) -> float:
    return float(compute_variance_inflation(np.array([part]), np.array([readings]), n)[0])


@pytest.mark.parametrize("count_kpa", [1e-9, 0.1])
@pytest.mark.parametrize("n", [40, 300, 1000])
def test_white_noise_lasts_in_two_tares_of_a_thousand(n: int, count_kpa: float) -> None:
    kpa = draw_readings_kpa(n, 2000, part=0.0, readings=1.0, seed=n, count_kpa=count_kpa)
    assert (fit_correlated_variance_fraction_and_decay(kpa).fraction > 0.0).mean() <= 2e-3


@pytest.mark.parametrize(("part", "readings"), [(1.0, 5.5), (0.5, 5.5), (0.5, 20.0), (0.3, 10.0)])
def test_half_a_second_shows_the_variance_of_a_mean(part: float, readings: float) -> None:
    kpa = draw_readings_kpa(300, 400, part=part, readings=readings, seed=3)
    found = compute_variance_inflation(*fit_correlated_variance_fraction_and_decay(kpa), 16)
    assert np.median(found) == pytest.approx(inflate(part, readings, 16), rel=0.12)
    assert (found == 1.0).mean() < 0.1  # taken for white


def test_the_variance_of_a_mean_is_a_sum_over_all_pairs() -> None:
    part, readings, n = 0.4, 7.0, 23
    apart = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    covariance = np.where(apart == 0, 1.0, part * math.exp(-1.0 / readings) ** apart)
    assert inflate(part, readings, n) == pytest.approx(covariance.sum() / n, rel=1e-12)


@given(part=st.floats(0.0, 1.0), readings=st.floats(0.1, 1000.0), n=st.integers(1, 10_000))
def test_a_mean_has_between_the_variance_of_white_noise_and_of_one_reading(
    part: float, readings: float, n: int
) -> None:
    assert 1.0 - 1e-9 <= inflate(part, readings, n) <= n * (1.0 + 1e-9)


def test_a_silent_a_constant_and_a_short_tile_have_white_noise() -> None:
    kpa = draw_readings_kpa(300, 3, part=1.0, readings=8.0, seed=1)
    kpa[:, 0], kpa[:, 1] = np.nan, 100.0
    part, readings = fit_correlated_variance_fraction_and_decay(kpa)
    assert part[:2].tolist() == readings[:2].tolist() == [0.0, 0.0]
    assert part[2] > 0.5
    assert fit_correlated_variance_fraction_and_decay(kpa[:31]).fraction.tolist() == [0.0, 0.0, 0.0]


def test_missing_readings_change_little() -> None:
    kpa = draw_readings_kpa(1000, 1, part=0.8, readings=6.0, seed=2)
    expected = compute_variance_inflation(*fit_correlated_variance_fraction_and_decay(kpa), 16)
    kpa[np.random.default_rng(0).random(1000) < 0.05] = np.nan
    found = compute_variance_inflation(*fit_correlated_variance_fraction_and_decay(kpa), 16)
    assert found == pytest.approx(expected, rel=0.2)
