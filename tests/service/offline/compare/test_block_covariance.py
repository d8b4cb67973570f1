"""Standard errors from blocks of time: right on average, also where few of them tell."""

from __future__ import annotations

import numpy as np
import pytest

from service.offline.compare.block_covariance import (
    UncertainValue,
    assign_blocks,
    compute_fit_uncertainty,
)


@pytest.mark.slow
@pytest.mark.parametrize("telling", [(0, 8000), (0, 700), (3000, 4500)])
def test_the_variance_of_independent_noise_is_the_textbooks(telling: tuple[int, int]) -> None:
    # In some hundred samples is all that tells of the slope, as in a single stance.
    rng, n, sigma = np.random.default_rng(1), 8000, 0.7
    slope = np.zeros(n)
    slope[slice(*telling)] = np.sin(np.linspace(0.0, 7.0, telling[1] - telling[0]))
    design = np.stack([np.ones(n), slope], axis=1)
    normal = design.T @ design
    found = np.zeros((2, 2))
    draws = 200
    for _ in range(draws):
        noise = rng.normal(0.0, sigma, n)
        residual = noise - design @ np.linalg.solve(normal, design.T @ noise)
        found += (
            compute_fit_uncertainty(design, residual, np.ones(n), np.arange(n)).covariance / draws
        )
    expected = sigma**2 * np.linalg.inv(normal)
    np.testing.assert_allclose(np.diag(found), np.diag(expected), rtol=0.12)


def test_a_long_rest_beside_three_stances_does_not_put_them_into_one_block() -> None:
    rng, rest, stances = np.random.default_rng(3), 24_000, 4000
    t = np.arange(stances + rest)
    load = np.where(t < stances, np.abs(np.sin(3.0 * np.pi * t / stances)), 0.0)
    weight = np.gradient(load) ** 2 / np.sum(np.gradient(load) ** 2) + 1.0 / len(t)
    score = (load * np.sin(t / 150.0) + 0.1 * rng.normal(size=len(t)))[:, None]
    block = assign_blocks(score, t, weight)
    assert len(np.unique(block[:stances])) >= 4
    assert 8 <= block.max() + 1 <= 20


def test_a_value_says_which_of_its_errors_makes_its_interval() -> None:
    drift_ppm = UncertainValue(87.0, 13.0, 8.0, 800.0)
    low_ppm, high_ppm = drift_ppm.interval_95
    assert (high_ppm - low_ppm) / 2 == pytest.approx(1.96 * 800.0, rel=1e-3)
    assert drift_ppm.is_mostly_repeating
    assert not UncertainValue(87.0, 400.0, 8.0, 400.0).is_mostly_repeating, "by Student's t"
    assert drift_ppm.scale_by(-1e-6).is_mostly_repeating
