"""Outliers: single readings far off are replaced, and what a foot does is not."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.estimation.models.denoise import find_outliers

NOISE_KPA = 0.165


def mended(kpa: list[float], noise_kpa: float = NOISE_KPA) -> tuple[list[float], list[int]]:
    """Readings with outliers replaced, and where there were any."""
    column = np.array(kpa, dtype=float)
    found = np.flatnonzero(find_outliers(column[:, None], np.array([noise_kpa])))
    out = column.copy()
    out[found] = 0.5 * (column[found - 1] + column[found + 1])
    return out.tolist(), found.tolist()


@pytest.mark.parametrize("off_kpa", [-30.0, -2.0, -0.7, 0.7, 10.0])
def test_a_reading_far_off_takes_the_mean_of_its_neighbours(off_kpa: float) -> None:
    assert mended([100.0, 100.2, 100.3 + off_kpa, 100.4, 100.4]) == (
        [100.0, 100.2, pytest.approx(100.3), 100.4, 100.4],
        [2],
    )


@pytest.mark.parametrize(
    "kpa",
    [
        [100.0, 100.0, 110.0, 110.0],
        [110.0, 110.0, 100.0, 100.0],
        [100.0, 105.0, 110.0, 115.0],
        [100.0, 100.3, 101.2, 102.7, 104.8],
        [100.0, 103.0, 104.5, 105.0, 104.5, 103.0],
    ],
)
def test_steps_slopes_bends_and_round_peaks_are_real(kpa: list[float]) -> None:
    assert mended(kpa) == (kpa, [])


def test_two_readings_off_together_are_no_single_outlier() -> None:
    assert mended([100.0, 100.0, 95.0, 95.0, 100.0, 100.0])[1] == []


@pytest.mark.parametrize("kpa", [[90.0, 100.0, 100.0], [100.0, 100.0, 90.0], [90.0], [90.0, 100.0]])
def test_the_first_and_the_last_are_never_outliers(kpa: list[float]) -> None:
    assert mended(kpa) == (kpa, [])


@pytest.mark.parametrize("nothing", [math.nan, math.inf, -math.inf])
def test_beside_a_reading_that_is_none_nothing_is_an_outlier(nothing: float) -> None:
    kpa = [100.0, nothing, 90.0, 100.0, 90.0, nothing, 100.0]
    out, found = mended(kpa)
    assert 2 not in found
    assert 4 not in found
    assert all(math.isfinite(out[i]) for i in (0, 2, 3, 4, 6))


@given(st.lists(st.floats(99.9, 100.1), min_size=3, max_size=30))
def test_noise_is_left_in_place(kpa: list[float]) -> None:
    assert mended(kpa) == (kpa, [])


def test_of_white_noise_one_reading_in_a_few_hundred_is_replaced() -> None:
    kpa = np.random.default_rng(1).normal(100.0, NOISE_KPA, 100_000)
    assert 1 / 800 < len(mended(kpa.tolist())[1]) / 100_000 < 1 / 300
