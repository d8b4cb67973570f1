"""`static`: the cubic in its range, its tangent below, its end above, and what it says of sigma."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.estimation.calibration import TileCalibration, make_paper_shape_preset
from service.estimation.models.static import StaticCurves, StaticForce
from tests.builders.calibrations import newton_tile

# F = 0.5 u + 0.1 u^2 + 0.02 u^3 with u = (p - 3) / 2, times 4; rising everywhere
CURVE = {
    "coefficients": (0.7, 0.5, 0.1, 0.02),
    "p_offset_kpa": 3.0,
    "p_scale_kpa": 2.0,
    "f_scale_n": 4.0,
    "range_kpa": (0.0, 15.0),
}


def by_definition_n(gauge_kpa: float) -> float:
    """The curve above, less its value at zero pressure."""

    def polynomial(p: float) -> float:
        u = (p - 3.0) / 2.0
        return 0.7 + 0.5 * u + 0.1 * u**2 + 0.02 * u**3

    return 4.0 * (polynomial(gauge_kpa) - polynomial(0.0))


def at(tile: TileCalibration, *gauge_kpa: float) -> StaticForce:
    return StaticCurves([tile]).compute_forces(np.array(gauge_kpa)[:, None])


@given(st.floats(0, 15))
def test_within_its_range_force_is_the_polynomial_less_its_value_at_zero(gauge_kpa: float) -> None:
    force_n = at(newton_tile("T01", **CURVE), gauge_kpa).force_n[0, 0]
    assert force_n == pytest.approx(by_definition_n(gauge_kpa), abs=1e-13)


@given(
    c=st.tuples(*[st.floats(-10, 10)] * 4),
    offset_kpa=st.floats(-20, 20),
    scale_kpa=st.floats(0.1, 20),
    scale_n=st.floats(0.01, 100),
)
def test_zero_pressure_is_exactly_zero_force(
    c: tuple[float, float, float, float], offset_kpa: float, scale_kpa: float, scale_n: float
) -> None:
    curve = CURVE | {
        "coefficients": (c[0], 1.0 + abs(c[1]), 0.0, abs(c[3])),
        "p_offset_kpa": offset_kpa,
        "p_scale_kpa": scale_kpa,
        "f_scale_n": scale_n,
    }
    assert at(newton_tile("T01", **curve), 0.0).force_n[0, 0] == 0.0


def test_zero_pressure_is_zero_force_even_if_the_entry_has_a_force_offset() -> None:
    # subtract_f0: the force, offset and all, less the same at zero pressure
    tile = newton_tile("T01", **CURVE, f_offset_n=1.5, zero_mode="subtract_f0")
    assert at(tile, 0.0, 5.0).force_n[:, 0].tolist() == [0.0, pytest.approx(by_definition_n(5.0))]


def test_as_fitted_keeps_offset_and_constant_term() -> None:
    tile = newton_tile("T01", **CURVE, f_offset_n=-2.0, zero_mode="as_fitted")
    # at p = 3 kPa u is 0: -2 + 4 * 0.7
    assert at(tile, 3.0).force_n[0, 0] == pytest.approx(0.8, abs=1e-14)
    # at p = 0, u = -1.5: -2 + 4 * (0.7 - 0.75 + 0.225 - 0.0675)
    assert at(tile, 0.0).force_n[0, 0] == pytest.approx(-1.57, abs=1e-14)


def test_below_zero_force_goes_on_along_the_tangent() -> None:
    # dF/dp at p = 0, u = -1.5: 4 / 2 * (0.5 - 0.3 + 0.135)
    assert at(newton_tile("T01", **CURVE), -0.5, -60.0).force_n[:, 0] == pytest.approx(
        [-0.5 * 0.67, -60 * 0.67], abs=1e-12
    )


def test_above_its_range_force_stays_at_the_end_as_a_lower_bound() -> None:
    end_n = by_definition_n(15.0)
    assert at(newton_tile("T01", **CURVE), 15.0, 15.1, 400.0).force_n[:, 0] == pytest.approx(end_n)


@given(st.floats(-5, 20))
def test_a_little_noise_about_zero_and_about_the_end_makes_no_jump(gauge_kpa: float) -> None:
    force_n = at(newton_tile("T01", **CURVE), gauge_kpa, gauge_kpa + 1e-9).force_n[:, 0]
    assert 0.0 <= force_n[1] - force_n[0] < 1e-7


@given(st.floats(-3, 14.9))
def test_the_slope_is_the_numerical_derivative_of_the_force(gauge_kpa: float) -> None:
    tile, h = newton_tile("T01", **CURVE), 1e-4
    before, after = at(tile, gauge_kpa - h, gauge_kpa + h).force_n[:, 0]
    slope = at(tile, gauge_kpa).slope_n_per_kpa[0, 0]
    assert slope == pytest.approx((after - before) / (2 * h), abs=1e-4)


def test_the_slope_at_zero_is_that_of_the_tangent() -> None:
    assert StaticCurves([newton_tile("T01", **CURVE)]).slope_at_zero_n_per_kpa[0] == pytest.approx(
        0.67
    )


def test_calibration_sigma_is_the_coefficients_covariance_in_newtons() -> None:
    # dF/dc_k = f_scale (u^k - u0^k); at p = 7: u = 2, u0 = -1.5, so 3.5, 1.75, 11.375
    covariance = ((0.04, 0.01, 0.0), (0.01, 0.09, -0.02), (0.0, -0.02, 0.01))
    d = np.array([3.5, 1.75, 11.375])
    expected_n = 4.0 * np.sqrt(d @ np.array(covariance) @ d)
    sigma_n = at(newton_tile("T01", **CURVE, covariance=covariance), 7.0, 0.0).fit_sigma_n[:, 0]
    assert sigma_n == pytest.approx([expected_n, 0.0], rel=1e-12)


def test_a_new_loadings_spread_grows_with_the_force() -> None:
    sigma_n = at(newton_tile("T01", **CURVE, relative_misfit=0.03), 0.0, 7.0, -1.0).fit_sigma_n[
        :, 0
    ]
    assert sigma_n == pytest.approx([0.0, 0.03 * by_definition_n(7.0), 0.03 * 0.67])


def test_a_loop_opens_with_the_first_newton_of_either_sign() -> None:
    # closed at zero, half open at one newton; p = -1 is -0.67 N on the tangent
    tile = newton_tile("T01", **CURVE, loop_misfit_n=0.4)
    force_n = by_definition_n(7.0)
    sigma_n = at(tile, 0.0, 7.0, -1.0).fit_sigma_n[:, 0]
    assert sigma_n == pytest.approx([0.0, 0.4 * force_n / (force_n + 1), 0.4 * 0.67 / 1.67])


def test_all_uncertainties_add_as_squares() -> None:
    covariance = ((0.04, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    misfit = {"relative_misfit": 0.03, "loop_misfit_n": 0.4}
    tile = newton_tile("T01", **CURVE, **misfit, covariance=covariance)
    force_n = by_definition_n(7.0)
    parts_n = (4.0 * 0.2 * 3.5, 0.03 * force_n, 0.4 * force_n / (force_n + 1))
    assert at(tile, 7.0).fit_sigma_n[0, 0] == pytest.approx(np.sqrt(np.square(parts_n).sum()))


def test_a_covariance_that_rounding_left_below_zero_is_no_complex_number() -> None:
    covariance = ((1.0, -1.0 - 1e-15, 0.0), (-1.0, 1.0, 0.0), (0.0, 0.0, 0.0))
    sigma_n = at(newton_tile("T01", **CURVE, covariance=covariance), 2.0, 4.0).fit_sigma_n
    assert np.isfinite(sigma_n).all()


def test_every_tile_has_its_own_curve() -> None:
    curves = StaticCurves(
        [
            newton_tile("T01", **CURVE),
            make_paper_shape_preset().get_tile_or_wildcard("T02"),
            newton_tile("T03"),
        ]
    )
    force_n = curves.compute_forces(np.array([[7.0, 15.0, 13 / 1023]])).force_n
    assert force_n[0] == pytest.approx([by_definition_n(7.0), 30.0, 0.1])


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_what_is_no_number_makes_no_exception(value: float) -> None:
    tile = newton_tile("T01", **CURVE, relative_misfit=0.01, loop_misfit_n=0.1)
    force_n = at(tile, value).force_n[0, 0]
    expected_n = {np.inf: by_definition_n(15.0)}.get(value, value)
    assert force_n == pytest.approx(expected_n, nan_ok=True)


@given(
    slopes=st.tuples(st.floats(0.01, 5), st.floats(0, 5), st.floats(0, 5)),
    offset_kpa=st.floats(-5, 0),
    gauge_kpa=st.lists(st.floats(-10, 30), min_size=2, max_size=30),
)
def test_more_pressure_is_never_less_force_where_the_curve_rises(
    slopes: tuple[float, float, float], offset_kpa: float, gauge_kpa: list[float]
) -> None:
    tile = newton_tile(
        "T01",
        coefficients=(0.0, *slopes),
        p_offset_kpa=offset_kpa,
        p_scale_kpa=4.0,
        range_kpa=(0.0, 15.0),
    )
    force_n = at(tile, *sorted(gauge_kpa)).force_n[:, 0]
    assert (np.diff(force_n) >= -1e-12 * np.abs(force_n).max()).all()
