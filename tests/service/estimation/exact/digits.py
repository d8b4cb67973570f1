"""Numbers of fifty digits by mpmath; None is missing."""

from __future__ import annotations

from typing import Any

import numpy as np
from mpmath import mp, mpf

Exact = Any
"""A number of fifty digits, or None."""


mp.dps = 50  # only the tests of this folder use mpmath


def exact(values: Any) -> list[Exact]:
    return [mpf(float(v)) if np.isfinite(v) else None for v in np.asarray(values, dtype=float)]


def apart(estimated: Any, expected: list[Exact]) -> float:
    """Return the greatest distance; NaN must meet None."""
    worst = 0.0
    for e, x in zip(np.ravel(estimated), expected, strict=True):
        assert np.isnan(e) == (x is None)
        worst = worst if x is None else max(worst, float(abs(mpf(float(e)) - x)))
    return worst
