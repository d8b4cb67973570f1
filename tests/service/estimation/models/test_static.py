"""`static` for inputs that no counts give: NaN, infinities, any curve, a rounded covariance."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.estimation.models.static import StaticForce, StaticParams, compute_forces
from tests.builders.calibrations import newton_tile

# F = 0.5 u + 0.1 u^2 + 0.02 u^3 with u = (p - 3) / 2, times 4; rising everywhere
CURVE = {
    "coefficients": (0.7, 0.5, 0.1, 0.02),
    "p_offset_kpa": 3.0,
    "p_scale_kpa": 2.0,
    "f_scale_n": 4.0,
    "range_kpa": (0.0, 15.0),
}


def compute(*gauge_kpa: float, **changes: Any) -> StaticForce:
    tile = newton_tile("T01", **CURVE | changes)
    return compute_forces(StaticParams.from_calibrations([tile]), np.array(gauge_kpa)[:, None])


@given(
    c=st.tuples(*[st.floats(-10, 10)] * 3),
    offset_kpa=st.floats(-20, 20),
    scale_kpa=st.floats(0.1, 20),
    scale_n=st.floats(0.01, 100),
)
def test_zero_pressure_is_exactly_zero_force(
    c: tuple[float, float, float], offset_kpa: float, scale_kpa: float, scale_n: float
) -> None:
    found = compute(
        0.0,
        coefficients=(c[0], 1.0 + abs(c[1]), 0.0, abs(c[2])),
        p_offset_kpa=offset_kpa,
        p_scale_kpa=scale_kpa,
        f_scale_n=scale_n,
    )
    assert found.force_n[0, 0] == 0.0


def test_no_number_is_no_force_and_the_greatest_pressure_the_end_of_the_range() -> None:
    force_n = compute(-math.inf, math.nan, math.inf, 15.0).force_n[:, 0]
    assert force_n[:3] == pytest.approx([-math.inf, math.nan, force_n[3]], nan_ok=True)


def test_a_covariance_rounded_below_zero_gives_a_finite_sigma() -> None:
    covariance = ((1.0, -1.0 - 1e-15, 0.0), (-1.0, 1.0, 0.0), (0.0, 0.0, 0.0))
    assert np.isfinite(compute(2.0, 4.0, covariance=covariance).fit_sigma_n).all()


@given(
    slopes=st.tuples(st.floats(0.01, 5), st.floats(0, 5), st.floats(0, 5)),
    offset_kpa=st.floats(-5, 0),
    gauge_kpa=st.lists(st.floats(-10, 30), min_size=2, max_size=30),
)
def test_more_pressure_on_a_rising_curve_is_never_less_force(
    slopes: tuple[float, float, float], offset_kpa: float, gauge_kpa: list[float]
) -> None:
    found = compute(*sorted(gauge_kpa), coefficients=(0.0, *slopes), p_offset_kpa=offset_kpa)
    assert (np.diff(found.force_n[:, 0]) >= -1e-12 * np.abs(found.force_n).max()).all()
