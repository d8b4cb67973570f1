"""Least squares over a few bounded unknowns (Levenberg-Marquardt), covariances and 95 % bands.

Residuals have unit variance, so a step that lowers their sum of squares by much less than 1 changes
no parameter by a relevant part of its uncertainty: the search ends there. Steps are solved from the
normal equations, which are small; an SVD of thousands of residuals for every step took as long as
the model itself.

The paper draws the mean of four repeats. The band of that mean is t(repeats - 1) times its standard
uncertainty, the standard deviation of repeats over the square root of their number: with four
repeats 3.18 times instead of 1.96 times. A single new loading scatters about the mean by the
standard deviation of a repeat.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import stdtrit

from devices.arrays import Bools, Floats
from service.estimation.calibration import (
    CUBIC_TERMS,
    TileCalibration,
    compute_share_of_final_loop_width,
)

_STEPS = 60  # a bound; a good start needs ten
COST_TOLERANCE = 1e-4
"""Decrease of the sum of squares at which the search ends: 0.01 standard uncertainties."""
_DIFFERENCE = 1e-6  # of an unknown's scale: balances rounding and curvature
_DAMPING = (1e-9, 1e-3, 1e9)  # least, first, and largest


@dataclass(frozen=True)
class LeastSquaresResult:
    """Minimum of a least-squares problem.

    Attributes:
        x: (unknowns,).
        residual: (residuals,).
        jacobian: (residuals, unknowns).
        at_bound: (unknowns,), True where a bound stops the search.
    """

    x: Floats
    residual: Floats
    jacobian: Floats
    at_bound: Bools


def minimize_squares(
    residual: Callable[[Floats], Floats],
    x: Floats,
    low: Floats,
    high: Floats,
    scale: Floats,
    min_cost_decrease: float = COST_TOLERANCE,
) -> LeastSquaresResult:
    """Minimize a sum of squares within bounds.

    Args:
        residual: function from unknowns (unknowns,) to residuals (residuals,) of unit variance.
        x: start values.
        low: lower bounds.
        high: upper bounds.
        scale: typical changes of the unknowns.
        min_cost_decrease: decrease of the sum of squares at which the search ends.
    """
    _, damping, most = _DAMPING
    off = residual(x)
    cost = float(off @ off)
    for _ in range(_STEPS):
        jacobian = _compute_jacobian(residual, x, off, high, scale)
        normal, slope = jacobian.T @ jacobian, jacobian.T @ off
        held = ((x <= low) & (slope > 0.0)) | ((x >= high) & (slope < 0.0))
        better = None
        while better is None and damping < most:
            trial = np.clip(x + _compute_step(normal, slope, held, damping), low, high)
            trial_off = residual(trial)
            trial_cost = float(trial_off @ trial_off)
            better = trial if trial_cost <= cost else None  # NaN is no better
            damping = max(_DAMPING[0], damping * (0.1 if better is not None else 10.0))
        if better is None:
            break
        gained, x, off, cost = cost - trial_cost, better, trial_off, trial_cost
        if gained < min_cost_decrease:
            break
    jacobian = _compute_jacobian(residual, x, off, high, scale)
    slope = jacobian.T @ off
    held = ((x <= low) & (slope > 0.0)) | ((x >= high) & (slope < 0.0))
    return LeastSquaresResult(x, off, jacobian, held)


def _compute_jacobian(
    residual: Callable[[Floats], Floats], x: Floats, off: Floats, high: Floats, scale: Floats
) -> Floats:
    columns = []
    for i, size in enumerate(_DIFFERENCE * scale):
        aside = x.copy()
        aside[i] += size if x[i] + size <= high[i] else -size
        columns.append((residual(aside) - off) / (aside[i] - x[i]))
    return np.stack(columns, axis=1)


def _compute_step(normal: Floats, slope: Floats, held: Bools, damping: float) -> Floats:
    """Compute the damped step of the unknowns that no bound stops."""
    free = np.flatnonzero(~held)
    step = np.zeros(len(slope))
    matrix = normal[np.ix_(free, free)]
    diagonal = np.maximum(np.diag(matrix), 1e-12 * np.diag(matrix).max(initial=0.0))
    step[free] = -np.linalg.solve(matrix + damping * np.diag(diagonal), slope[free])
    return step


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


def compute_curve_through_zero_n(tile: TileCalibration, gauge_kpa: Floats) -> Floats:
    """Compute the cubic's force at gauge pressures (m,), zero at zero for any `zero_mode`."""
    coefficients = np.array(tile.coefficients[1:]) * tile.f_scale_n
    return np.asarray(_compute_tile_basis(tile, gauge_kpa) @ coefficients)


def compute_mean_curve_half_width_95_n(tile: TileCalibration, gauge_kpa: Floats) -> Floats:
    """Compute the half width of the mean curve's 95 % band, from the covariance over repeats."""
    return compute_student_t_95(tile.repeats) * np.sqrt(_compute_mean_variance(tile, gauge_kpa))


def compute_new_loading_half_width_95_n(tile: TileCalibration, gauge_kpa: Floats) -> Floats:
    """Compute the half width of the 95 % interval of a reading in a new loading, in N.

    It consists of the mean's uncertainty, the gain of a new loading, and its hysteresis loop.
    """
    force_n = compute_curve_through_zero_n(tile, gauge_kpa)
    variance = (
        _compute_mean_variance(tile, gauge_kpa)
        + (tile.relative_misfit * force_n) ** 2
        + (tile.loop_misfit_n * compute_share_of_final_loop_width(force_n)) ** 2
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
