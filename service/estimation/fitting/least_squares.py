"""Least squares of many residuals over a few bounded unknowns (Levenberg-Marquardt).

Residuals have unit variance, so a step that lowers their sum of squares by much less than 1 changes
no parameter by a relevant part of its uncertainty: the search ends there. Steps are solved from the
normal equations, which are small; an SVD of thousands of residuals for every step took as long as
the model itself.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from devices.arrays import Bools, Floats

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
