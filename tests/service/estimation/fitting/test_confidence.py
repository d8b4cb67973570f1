"""Bands over repeats, against a table of Student's t and against the closed form for gains."""

from __future__ import annotations

import numpy as np
import pytest

from service.estimation.fitting.least_squares import (
    compute_curve_n,
    compute_curve_student_t_half_width_95_n,
    compute_new_loading_half_width_95_n,
    compute_student_t_95,
)
from service.estimation.models.static import StaticCurves
from tests.builders.calibrations import newton_tile


@pytest.mark.parametrize(
    ("repeats", "t"),
    [(2, 12.7062), (3, 4.3027), (4, 3.1824), (5, 2.7764), (8, 2.3646), (31, 2.0423)],
)
def test_students_t_is_that_of_the_printed_tables(repeats: int, t: float) -> None:
    assert compute_student_t_95(repeats) == pytest.approx(t, abs=5e-5)


def test_with_very_many_repeats_it_becomes_the_normal_distributions() -> None:
    assert compute_student_t_95(1_000_001) == pytest.approx(1.95996, abs=1e-4)


def test_a_single_repeat_has_no_band() -> None:
    with pytest.raises(ValueError, match="at least 2"):
        compute_student_t_95(1)


def test_the_band_of_the_mean_is_t_times_the_standard_error() -> None:
    # One newton per unit, gain known to 2 %: 3.1824 x 2 % of the force.
    tile = newton_tile(
        "T01", covariance=((0.02**2, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), repeats=4
    )
    gauge_kpa = np.linspace(0.0, tile.range_kpa[1], 7)
    expected_n = 3.182446 * 0.02 * compute_curve_n(tile, gauge_kpa)
    np.testing.assert_allclose(
        compute_curve_student_t_half_width_95_n(tile, gauge_kpa), expected_n, rtol=1e-6
    )


def test_the_band_of_a_new_loading_adds_its_own_gain_and_loop() -> None:
    tile = newton_tile("T01", relative_misfit=0.03, loop_misfit_n=0.5, repeats=4)
    gauge_kpa = np.array([0.0, tile.range_kpa[1]])
    half_n = compute_new_loading_half_width_95_n(tile, gauge_kpa)
    assert half_n[0] == 0.0
    # 150 N: 4.5 N of gain and 0.5 N of a loop that is open to 150/151.
    assert half_n[1] == pytest.approx(3.182446 * np.hypot(4.5, 0.5 * 150 / 151), rel=1e-6)
    assert (compute_curve_student_t_half_width_95_n(tile, gauge_kpa) == 0.0).all()


def test_a_new_loadings_band_is_t_times_what_the_estimate_takes_as_its_sigma() -> None:
    tile = newton_tile(
        "T01",
        covariance=((0.001, 0.0001, 0.0), (0.0001, 0.0002, 0.0), (0.0, 0.0, 0.0001)),
        relative_misfit=0.03,
        loop_misfit_n=0.2,
        p_offset_kpa=3.0,
    )
    gauge_kpa = np.linspace(0.0, tile.range_kpa[1], 11)
    sigma_n = StaticCurves([tile]).compute_forces(gauge_kpa[:, None]).fit_sigma_n[:, 0]
    np.testing.assert_allclose(
        compute_new_loading_half_width_95_n(tile, gauge_kpa),
        compute_student_t_95(4) * sigma_n,
        rtol=1e-9,
    )
