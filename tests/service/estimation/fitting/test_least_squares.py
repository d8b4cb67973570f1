"""`minimize_squares` against closed forms and scipy, and confidence bands over repeats."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.optimize
from hypothesis import given, settings
from hypothesis import strategies as st

from service.estimation.effects import WALL_PER_KPA
from service.estimation.fitting.dome_model import (
    DomeModel,
    FittedEffects,
    compute_creep_range_s,
    list_unknowns,
)
from service.estimation.fitting.effects_fit import (
    _convert_centred_cubic_to_c1_c2_c3,
    collect_loadings_at_common_baseline,
)
from service.estimation.fitting.least_squares import (
    compute_curve_through_zero_n,
    compute_mean_curve_half_width_95_n,
    compute_new_loading_half_width_95_n,
    compute_student_t_95,
    minimize_squares,
)
from service.estimation.fitting.output_error import OutputErrorProblem
from service.estimation.fitting.static_fit import fit_static_curve
from service.estimation.models.static import StaticParams, compute_forces
from tests.builders.calibrations import newton_tile
from tests.service.estimation.fitting.recordings import record

WIDE = np.full(3, 100.0)


@settings(max_examples=30)
@given(seed=st.integers(0, 1000))
def test_a_linear_problem_is_solved_as_by_lstsq(seed: int) -> None:
    rng = np.random.default_rng(seed)
    design, y = rng.normal(size=(40, 3)), rng.normal(size=40)
    found = minimize_squares(lambda x: design @ x - y, np.zeros(3), -WIDE, WIDE, np.ones(3))
    exact, *_ = np.linalg.lstsq(design, y, rcond=None)
    sigma = np.sqrt(np.diag(np.linalg.inv(design.T @ design)))
    assert (np.abs(found.x - exact) < 0.02 * sigma).all()
    assert not found.at_bound.any()
    np.testing.assert_allclose(found.jacobian, design, atol=1e-6)


@settings(max_examples=30)
@given(seed=st.integers(0, 1000))
def test_a_bounded_problem_is_solved_as_by_scipy(seed: int) -> None:
    rng = np.random.default_rng(seed)
    t, truth = np.linspace(0.0, 5.0, 80), rng.uniform(0.2, 3.0, 3)
    low, high = np.full(3, 0.5), np.full(3, 2.0)

    def curve(x: np.ndarray) -> np.ndarray:
        return np.asarray(x[0] * np.exp(-x[1] * t) + x[2])

    y = curve(truth) + rng.normal(0, 0.05, len(t))

    def off(x: np.ndarray) -> np.ndarray:
        return (curve(x) - y) / 0.05

    found = minimize_squares(off, np.ones(3), low, high, np.ones(3))
    inside = found.x.clip(low + 1e-9, high - 1e-9)
    other = scipy.optimize.least_squares(off, inside, bounds=(low, high))
    assert found.residual @ found.residual <= 2.0 * other.cost + 2e-3
    assert ((found.x == low) | (found.x == high))[found.at_bound].all()
    assert (found.x >= low).all()
    assert (found.x <= high).all()


def test_a_bent_valley_is_followed_to_its_minimum() -> None:
    found = minimize_squares(
        lambda x: np.array([100.0 * (x[1] - x[0] ** 2), 10.0 * (1.0 - x[0])]),
        np.array([-1.2, 1.0]), -WIDE[:2], WIDE[:2], np.ones(2),
    )  # fmt: skip
    assert found.x == pytest.approx([1.0, 1.0], abs=1e-3)


@pytest.mark.slow
def test_a_tiles_fit_is_within_a_tenth_of_sigma_of_a_long_search() -> None:
    recording = record(seed=0)
    tile = fit_static_curve(recording)
    points, baseline_kpa = collect_loadings_at_common_baseline([recording])
    static = DomeModel(
        _convert_centred_cubic_to_c1_c2_c3(tile.coefficients),
        tile.range_kpa[1],
        baseline_kpa,
        WALL_PER_KPA,
    )
    problem = OutputErrorProblem(points, static)
    fit = problem.fit(FittedEffects(terms=2, flow=False))
    unknowns = list_unknowns(
        FittedEffects(terms=2, flow=False), static.curve, compute_creep_range_s(points)
    )
    likely = np.concatenate([each.prior for each in unknowns])
    within = np.concatenate([np.full(len(each.prior), each.prior_sigma) for each in unknowns])
    model = fit.model
    x = np.concatenate(
        [
            model.curve, [model.late_s, model.gamma, np.log(model.tau_s)], model.part,
            np.log(model.creep_s), model.loop,
        ]
    )  # fmt: skip
    names = ("late_s", "gamma", "ln_tau", "part", "ln_creep", "loop")
    curve_sigma = np.sqrt(np.diag(fit.curve_covariance))
    sigma = np.concatenate([curve_sigma, *(fit.sigma[name] for name in names)])

    def residual(steps: np.ndarray) -> np.ndarray:
        at = x + steps * sigma
        tried = DomeModel(
            at[:3], static.scale_kpa, baseline_kpa, WALL_PER_KPA, late_s=at[3], gamma=at[4],
            tau_s=np.exp(at[5]), part=at[6:8], creep_s=np.exp(at[8:10]), loop=at[10:],
        )  # fmt: skip
        return np.concatenate(
            [
                problem.compute_pressure_and_gain_residuals(tried, fit.scatter),
                (at - likely) / within,
            ]
        )

    other = scipy.optimize.least_squares(
        residual, np.zeros(len(x)), ftol=1e-12, xtol=1e-12, gtol=1e-12,
        diff_step=np.full(len(x), 1e-4), max_nfev=40,
    )  # fmt: skip
    assert np.abs(other.x).max() < 0.1


# --- confidence bands -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("repeats", "t"),
    [
        *((2, 12.7062), (3, 4.3027), (4, 3.1824), (5, 2.7764), (8, 2.3646), (31, 2.0423)),
        (1_000_001, 1.95996),  # the normal distribution's
    ],
)
def test_students_t_is_that_of_the_printed_tables(repeats: int, t: float) -> None:
    assert compute_student_t_95(repeats) == pytest.approx(t, abs=5e-5)


def test_a_single_repeat_has_no_band() -> None:
    with pytest.raises(ValueError, match="at least 2"):
        compute_student_t_95(1)


def test_the_band_of_the_mean_is_t_times_the_standard_error() -> None:
    # One newton per unit, gain known to 2 %: 3.1824 x 2 % of the force.
    tile = newton_tile("T01", covariance=((0.02**2, 0.0, 0.0), (0.0,) * 3, (0.0,) * 3), repeats=4)
    gauge_kpa = np.linspace(0.0, tile.range_kpa[1], 7)
    expected_n = 3.182446 * 0.02 * compute_curve_through_zero_n(tile, gauge_kpa)
    assert compute_mean_curve_half_width_95_n(tile, gauge_kpa) == pytest.approx(
        expected_n, rel=1e-6
    )


def test_the_band_of_a_new_loading_is_t_times_the_sigma_of_an_estimate() -> None:
    tile = newton_tile(
        "T01",
        covariance=((0.001, 0.0001, 0.0), (0.0001, 0.0002, 0.0), (0.0, 0.0, 0.0001)),
        relative_misfit=0.03,
        loop_misfit_n=0.2,
        p_offset_kpa=3.0,
        repeats=4,
    )
    gauge_kpa = np.linspace(0.0, tile.range_kpa[1], 11)
    sigma_n = compute_forces(
        StaticParams.from_calibrations([tile]), gauge_kpa[:, None]
    ).fit_sigma_n[:, 0]
    found_n = compute_new_loading_half_width_95_n(tile, gauge_kpa)
    assert found_n == pytest.approx(compute_student_t_95(4) * sigma_n, rel=1e-9)
    assert found_n[0] == 0.0
