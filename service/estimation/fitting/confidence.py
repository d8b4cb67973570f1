"""95 % bands of a calibration, with Student's t, because repeats on a bench are few.

The paper draws the mean of four repeats. The band of that mean is t(repeats - 1) times its standard
uncertainty, which is the spread of repeats over the square root of their number: with four repeats
3.18 of them instead of 1.96. A single new loading scatters about the mean more widely, by the
spread of a repeat itself.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.special import stdtrit

from devices.arrays import Bools, Floats
from service.estimation.calibration import BASIS, TileCalibration, loop_share

_UPPER_95 = 0.975


def fit_covariance(jacobian: Any, known: Floats) -> Floats:
    """Covariance of the parameters of a least-squares fit whose residuals have unit variance.

    Args:
        jacobian: (residuals, parameters).
        known: (parameters,), standard uncertainties before any residual: what the residuals do not
            tell, as the time of a part that is zero, is not known better than that.
    """
    j = np.asarray(jacobian) * known
    return np.asarray(np.linalg.inv(j.T @ j + np.eye(len(known))) * np.outer(known, known))


def beyond_bounds(jacobian: Any, residual: Floats, known: Floats, held: Bools) -> Floats:
    """How far beyond their bounds the parameters that are held back would go, to first order.

    What is not possible but fits better says that something else is wrong: the parameter is as
    uncertain as that. No more than `known`; zero for parameters that are free.
    """
    if not held.any():
        return np.zeros(len(known))
    j = np.asarray(jacobian) * known
    step = np.linalg.solve(j.T @ j + np.eye(len(known)), -j.T @ residual)
    return np.asarray(np.where(held, np.minimum(np.abs(step), 1.0) * known, 0.0))


def student_t_95(repeats: int) -> float:
    """Half width of a two-sided 95 % interval in standard uncertainties, from so many repeats.

    Raises:
        ValueError: fewer than two repeats have no spread.
    """
    if repeats < 2:
        raise ValueError(f"{repeats} repeats have no spread; at least 2 are needed")
    return float(stdtrit(repeats - 1, _UPPER_95))


def curve_n(tile: TileCalibration, gauge_kpa: Floats) -> Floats:
    """Force of the cubic at gauge pressures (m,), zero at zero pressure."""
    coefficients = np.array(tile.coefficients[1:]) * tile.f_scale_n
    return np.asarray(_basis_of(tile, gauge_kpa) @ coefficients)


def mean_band_n(tile: TileCalibration, gauge_kpa: Floats) -> Floats:
    """Half width of the 95 % band of the mean curve, from the covariance over repeats."""
    return student_t_95(tile.repeats) * np.sqrt(_mean_variance(tile, gauge_kpa))


def new_loading_band_n(tile: TileCalibration, gauge_kpa: Floats) -> Floats:
    """Half width of the band in which a single new reading lies in 95 of 100 loadings.

    The mean's own uncertainty, a gain of the new loading's own, and its hysteresis loop.
    """
    force_n = curve_n(tile, gauge_kpa)
    variance = (
        _mean_variance(tile, gauge_kpa)
        + (tile.relative_misfit * force_n) ** 2
        + (tile.loop_misfit_n * loop_share(force_n)) ** 2
    )
    return student_t_95(tile.repeats) * np.sqrt(variance)


def _mean_variance(tile: TileCalibration, gauge_kpa: Floats) -> Floats:
    basis = _basis_of(tile, gauge_kpa)
    covariance = np.array(tile.covariance) * tile.f_scale_n**2
    return np.asarray(np.maximum(((basis @ covariance) * basis).sum(axis=1), 0.0))


def _basis_of(tile: TileCalibration, gauge_kpa: Floats) -> Floats:
    return cubic_basis(gauge_kpa, tile.p_offset_kpa, tile.p_scale_kpa)


def cubic_basis(gauge_kpa: Floats, offset_kpa: float, scale_kpa: float) -> Floats:
    """Basis u^k - u0^k of a cubic, (m, 3), which is zero at zero pressure by construction."""
    u = (gauge_kpa - offset_kpa) / scale_kpa
    u0 = -offset_kpa / scale_kpa
    return np.stack([u**k - u0**k for k in range(1, BASIS + 1)], axis=1)
