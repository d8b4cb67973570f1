"""`static`: the cubic in its range, its tangent below, its end above, and its sigma."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.estimation.calibration import make_paper_shape_preset
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
SLOPE_AT_ZERO = 0.67  # dF/dp at p = 0, u = -1.5: 4 / 2 * (0.5 - 0.3 + 0.135)


def compute_by_definition_n(gauge_kpa: float) -> float:
    """Return the curve above, less its value at zero pressure."""
    at, zero = (np.polyval((0.02, 0.1, 0.5, 0.7), (p - 3.0) / 2.0) for p in (gauge_kpa, 0.0))
    return float(4.0 * (at - zero))


AT_7_N, END_N = compute_by_definition_n(7.0), compute_by_definition_n(15.0)


def compute(*gauge_kpa: float, **changes: Any) -> StaticForce:
    tile = newton_tile("T01", **CURVE | changes)
    return compute_forces(StaticParams.from_calibrations([tile]), np.array(gauge_kpa)[:, None])


@given(st.floats(0, 15))
def test_a_force_within_the_range_is_the_polynomial_less_its_zero(gauge_kpa: float) -> None:
    expected_n = compute_by_definition_n(gauge_kpa)
    assert compute(gauge_kpa).force_n[0, 0] == pytest.approx(expected_n, abs=1e-13)


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


@pytest.mark.parametrize(
    ("changes", "force_n_at_kpa"),
    [
        ({}, {-60.0: -60 * SLOPE_AT_ZERO, -0.5: -0.5 * SLOPE_AT_ZERO}),
        ({}, {15.0: END_N, 15.1: END_N, 400.0: END_N, math.inf: END_N}),
        ({}, {-math.inf: -math.inf, math.nan: math.nan}),
        ({"f_offset_n": 1.5, "zero_mode": "subtract_f0"}, {0.0: 0.0, 7.0: AT_7_N}),
        # At p = 3 kPa u is 0: -2 + 4 * 0.7; at p = 0: -2 + 4 * (0.7 - 0.75 + 0.225 - 0.0675).
        ({"f_offset_n": -2.0, "zero_mode": "as_fitted"}, {3.0: 0.8, 0.0: -1.57}),
    ],
    ids=["tangent below", "end above", "no number", "zero less offset", "zero as fitted"],
)
def test_a_force_at_zero_and_outside_the_range_follows_the_entry(
    changes: dict[str, Any], force_n_at_kpa: dict[float, float]
) -> None:
    found = compute(*force_n_at_kpa, **changes, relative_misfit=0.01, loop_misfit_n=0.1)
    expected_n = list(force_n_at_kpa.values())
    assert found.force_n[:, 0] == pytest.approx(expected_n, abs=1e-12, nan_ok=True)


@given(st.floats(-3, 14.9))
def test_the_slope_is_the_derivative_of_the_force(gauge_kpa: float) -> None:
    before_n, _, after_n = compute(gauge_kpa - 1e-4, gauge_kpa, gauge_kpa + 1e-4).force_n[:, 0]
    slope = compute(gauge_kpa).slope_n_per_kpa[0, 0]
    assert slope == pytest.approx((after_n - before_n) / 2e-4, abs=1e-4)


def test_every_tile_has_its_own_curve() -> None:
    paper = make_paper_shape_preset().get_tile_or_wildcard("T02")
    curves = StaticParams.from_calibrations(
        [newton_tile("T01", **CURVE), paper, newton_tile("T03")]
    )
    force_n = compute_forces(curves, np.array([[7.0, 15.0, 13 / 1023]])).force_n
    assert force_n[0] == pytest.approx([AT_7_N, 30.0, 0.1])
    assert curves["slope_at_zero_n_per_kpa"][0] == pytest.approx(SLOPE_AT_ZERO)


def test_the_fits_sigma_is_the_covariance_of_its_coefficients() -> None:
    # dF/dc_k = f_scale (u^k - u0^k); at p = 7: u = 2, u0 = -1.5, so 3.5, 1.75, 11.375
    covariance = ((0.04, 0.01, 0.0), (0.01, 0.09, -0.02), (0.0, -0.02, 0.01))
    d = np.array([3.5, 1.75, 11.375])
    expected_n = 4.0 * np.sqrt(d @ np.array(covariance) @ d)
    sigma_n = compute(7.0, 0.0, covariance=covariance).fit_sigma_n[:, 0]
    assert sigma_n == pytest.approx([expected_n, 0.0], rel=1e-12)


@pytest.mark.parametrize(
    ("misfits", "sigma_n"),
    [
        ({"relative_misfit": 0.03}, [0.0, 0.03 * AT_7_N, 0.03 * SLOPE_AT_ZERO]),
        # Closed at zero, half open at one newton.
        ({"loop_misfit_n": 0.4}, [0.0, 0.4 * AT_7_N / (AT_7_N + 1), 0.4 * 0.67 / 1.67]),
        (
            {
                "relative_misfit": 0.03,
                "loop_misfit_n": 0.4,
                "covariance": ((0.04, 0.0, 0.0), (0.0,) * 3, (0.0,) * 3),
            },
            [
                0.0,
                math.hypot(0.8 * 3.5, 0.03 * AT_7_N, 0.4 * AT_7_N / (AT_7_N + 1)),
                math.hypot(0.03 * SLOPE_AT_ZERO, 0.4 * 0.67 / 1.67),
            ],
        ),
    ],
    ids=["of a loading", "of the loop", "of all as squares"],
)
def test_the_sigma_has_the_misfits_of_the_entry(
    misfits: dict[str, Any], sigma_n: list[float]
) -> None:
    assert compute(0.0, 7.0, -1.0, **misfits).fit_sigma_n[:, 0] == pytest.approx(sigma_n)


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
