"""Covariances and 95 % bands of a calibration, with Student's t for few repeats.

The paper draws the mean of four repeats. The band of that mean is t(repeats - 1) times its standard
uncertainty, the standard deviation of repeats over the square root of their number: with four
repeats 3.18 times instead of 1.96 times. A single new loading scatters about the mean by the
standard deviation of a repeat.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.special import stdtrit

from devices.arrays import Bools, Floats
from service.estimation.calibration import CUBIC_TERMS, TileCalibration, compute_relative_loop_width

_UPPER_95 = 0.975


def compute_fit_covariance(jacobian: Any, prior_sigma: Floats) -> Floats:
    """Compute the covariance of a least-squares fit with priors and residuals of unit variance.

    Args:
        jacobian: (residuals, parameters).
        prior_sigma: (parameters,), prior standard uncertainties, which stay for parameters that the
            residuals do not determine, such as the time constant of a fraction of zero.
    """
    j = np.asarray(jacobian) * prior_sigma
    return np.asarray(
        np.linalg.inv(j.T @ j + np.eye(len(prior_sigma))) * np.outer(prior_sigma, prior_sigma)
    )


def compute_step_beyond_bound(
    jacobian: Any, residual: Floats, prior_sigma: Floats, at_bound: Bools
) -> Floats:
    """Compute how far parameters at a bound would step beyond it, to first order; 0 for the others.

    A better fit beyond a bound shows an error of the model, and adds to the uncertainty. At most
    `prior_sigma`; zero for the other parameters.
    """
    if not at_bound.any():
        return np.zeros(len(prior_sigma))
    j = np.asarray(jacobian) * prior_sigma
    step = np.linalg.solve(j.T @ j + np.eye(len(prior_sigma)), -j.T @ residual)
    return np.asarray(np.where(at_bound, np.minimum(np.abs(step), 1.0) * prior_sigma, 0.0))


def compute_student_t_95(repeats: int) -> float:
    """Return the half width of a two-sided 95 % interval in standard uncertainties.

    Raises:
        ValueError: fewer than two repeats have no spread.
    """
    if repeats < 2:
        raise ValueError(f"{repeats} repeats have no spread; at least 2 are needed")
    return float(stdtrit(repeats - 1, _UPPER_95))


def compute_curve_n(tile: TileCalibration, gauge_kpa: Floats) -> Floats:
    """Compute the cubic's force at gauge pressures (m,), zero at zero for any `zero_mode`."""
    coefficients = np.array(tile.coefficients[1:]) * tile.f_scale_n
    return np.asarray(_compute_tile_basis(tile, gauge_kpa) @ coefficients)


def compute_mean_half_width_95_n(tile: TileCalibration, gauge_kpa: Floats) -> Floats:
    """Compute the half width of the mean curve's 95 % band, from the covariance over repeats."""
    return compute_student_t_95(tile.repeats) * np.sqrt(_compute_mean_variance(tile, gauge_kpa))


def compute_new_loading_half_width_95_n(tile: TileCalibration, gauge_kpa: Floats) -> Floats:
    """Compute the half width of the 95 % interval of a reading in a new loading, in N.

    It consists of the mean's uncertainty, the gain of a new loading, and its hysteresis loop.
    """
    force_n = compute_curve_n(tile, gauge_kpa)
    variance = (
        _compute_mean_variance(tile, gauge_kpa)
        + (tile.relative_misfit * force_n) ** 2
        + (tile.loop_misfit_n * compute_relative_loop_width(force_n)) ** 2
    )
    return compute_student_t_95(tile.repeats) * np.sqrt(variance)


def _compute_mean_variance(tile: TileCalibration, gauge_kpa: Floats) -> Floats:
    basis = _compute_tile_basis(tile, gauge_kpa)
    covariance = np.array(tile.covariance) * tile.f_scale_n**2
    return np.asarray(np.maximum(((basis @ covariance) * basis).sum(axis=1), 0.0))


def _compute_tile_basis(tile: TileCalibration, gauge_kpa: Floats) -> Floats:
    return compute_cubic_basis_through_zero(gauge_kpa, tile.p_offset_kpa, tile.p_scale_kpa)


def compute_cubic_basis_through_zero(
    gauge_kpa: Floats, offset_kpa: float, scale_kpa: float
) -> Floats:
    """Compute the basis u^k - u0^k of a cubic, (m, 3), zero at zero pressure by construction."""
    u = (gauge_kpa - offset_kpa) / scale_kpa
    u0 = -offset_kpa / scale_kpa
    return np.stack([u**k - u0**k for k in range(1, CUBIC_TERMS + 1)], axis=1)
