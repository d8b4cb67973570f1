"""The fit of a tile's curve to indentations with a known curve."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.chips.mpl115a2 import MPL115A2
from devices.errors import CalibrationError
from service.estimation.calibration import TileCalibration
from service.estimation.fitting.rig.indentation import Indentation
from service.estimation.fitting.static_fit import fit_static_curve
from service.estimation.models.static import StaticParams, compute_forces

Curve = Callable[[np.ndarray], np.ndarray]

FULL_KPA = 16.0
BASELINE_KPA = 100.3


def compute_true_n(gauge_kpa: np.ndarray) -> np.ndarray:
    """Compute the force on a stiffening dome: 29.8 N at 16 kPa."""
    return np.asarray(1.5 * gauge_kpa - 0.05 * gauge_kpa**2 + 0.0045 * gauge_kpa**3)


def record(
    *,
    load: Curve = compute_true_n,
    unload: Curve | None = None,
    gains: tuple[float, ...] = (1.0,) * 4,
    full_kpa: float = FULL_KPA,
    readings: int = 60,
    noise_kpa: float = 0.0,
    noise_n: float = 0.0,
    seed: int = 0,
    rest: int = 40,
    more: tuple[tuple[str, float, float], ...] = (),
) -> Indentation:
    """Record slow strokes of `readings` each way, their force times the repeat's gain.

    With 60 readings every block is one reading, so a block's mean lies on the curve.
    """
    kpa, force_n, phase = [np.zeros(rest)], [np.zeros(rest)], ["rest"] * rest
    way_in = np.linspace(0.0, full_kpa, readings)
    for gain in gains:
        for name, path, curve in (
            ("load", way_in, load),
            ("unload", way_in[::-1], unload or load),
        ):
            kpa.append(path)
            force_n.append(gain * curve(path))
            phase += [name] * readings
        kpa.append(np.zeros(20))
        force_n.append(np.zeros(20))
        phase += ["rest"] * 20
    for name, gauge_kpa, at_n in more:
        kpa.append(np.full(30, gauge_kpa))
        force_n.append(np.full(30, at_n))
        phase += [name] * 30
    rng = np.random.default_rng(seed)
    n = len(phase)
    return Indentation(
        chip=MPL115A2,
        serial="T01",
        where="bench.parquet",
        t_ns=np.arange(n, dtype=np.int64) * 2_000_000,
        kpa=BASELINE_KPA + np.concatenate(kpa) + noise_kpa * rng.standard_normal(n),
        reference_n=np.concatenate(force_n) + noise_n * rng.standard_normal(n),
        phase=np.array(phase),
        is_under_indenter=np.ones(n, dtype=bool),
        temperature_raw=np.full(n, 500.0),
    )


def compute_fitted_n(tile: TileCalibration, gauge_kpa: np.ndarray) -> np.ndarray:
    return compute_forces(StaticParams.from_calibrations([tile]), gauge_kpa[:, None]).force_n[:, 0]


def test_a_known_cubic_is_recovered_without_noise() -> None:
    tile = fit_static_curve(record())
    gauge_kpa = np.linspace(0.0, FULL_KPA, 501)
    assert np.abs(compute_fitted_n(tile, gauge_kpa) - compute_true_n(gauge_kpa)).max() < 1e-6
    assert tile.range_kpa == pytest.approx((0.0, FULL_KPA))
    assert tile.baseline_kpa == pytest.approx(BASELINE_KPA)
    assert tile.noise_kpa == pytest.approx(0.0, abs=1e-12)
    assert (tile.repeats, tile.monotonic, tile.absolute_scale) == (4, True, "measured")
    assert tile.r2 == pytest.approx(1.0, abs=1e-12)
    for error_n in (tile.rmse_n, tile.cv_rmse_n, tile.hysteresis_n):
        assert error_n == pytest.approx(0.0, abs=1e-9)
    assert max(tile.relative_misfit, tile.loop_misfit_n) < 1e-9


@settings(max_examples=30, deadline=None)
@given(
    full_kpa=st.floats(3.1, 60.0),
    end_n=st.floats(5.0, 60.0),
    bends=st.tuples(st.floats(-0.25, 0.5), st.floats(0.0, 0.5)),
)
def test_any_rising_cubic_is_recovered(
    full_kpa: float, end_n: float, bends: tuple[float, float]
) -> None:
    def curve(gauge_kpa: np.ndarray) -> np.ndarray:
        x = gauge_kpa / full_kpa
        return np.asarray(end_n * (x + bends[0] * x**2 + bends[1] * x**3))

    tile = fit_static_curve(record(load=curve, full_kpa=full_kpa))
    gauge_kpa = np.linspace(0.0, full_kpa, 101)
    assert np.abs(compute_fitted_n(tile, gauge_kpa) - curve(gauge_kpa)).max() < 1e-6


def test_the_fit_is_well_conditioned() -> None:
    # In raw kPa, 100 to 116, the basis has a condition number beyond 1e12, and an error of 1e-10
    # in the readings would come out as newtons. Centred, it comes out as itself.
    gauge_kpa = np.linspace(0.0, FULL_KPA, 101)
    exact = compute_fitted_n(fit_static_curve(record()), gauge_kpa)
    disturbed = compute_fitted_n(
        fit_static_curve(record(noise_kpa=1e-10, noise_n=1e-10)), gauge_kpa
    )
    assert np.abs(disturbed - exact).max() < 1e-9


def test_the_noise_of_a_chip_does_not_bias_the_fit() -> None:
    gauge_kpa = np.array([1.0, 4.0, 8.0, 12.0, 15.0])
    errors_n = np.array(
        [
            compute_fitted_n(fit_static_curve(recording), gauge_kpa) - compute_true_n(gauge_kpa)
            for recording in (
                record(readings=1800, rest=500, noise_kpa=0.165, seed=seed) for seed in range(16)
            )
        ]
    )
    # One recording is good to some 0.02 N, so the mean of sixteen shows a bias of as much.
    assert errors_n.std(axis=0).max() < 0.05
    assert np.abs(errors_n.mean(axis=0)).max() < 0.02


def test_holds_releases_and_taps_change_no_bit() -> None:
    absurd = (("hold", 3.0, 99.0), ("release", 2.0, -50.0), ("rest", 0.0, 0.0), ("tap", 1.0, 70.0))
    assert fit_static_curve(record(more=absurd)) == fit_static_curve(record())


def test_the_hysteresis_of_a_known_loop_is_its_greatest_width() -> None:
    # Branches 0.45 N above and below the curve at half range, none apart at the ends.
    def half_width_n(p: np.ndarray) -> np.ndarray:
        return 0.45 * 4 * (p / FULL_KPA) * (1 - p / FULL_KPA)

    tile = fit_static_curve(
        record(
            load=lambda p: compute_true_n(p) + half_width_n(p),
            unload=lambda p: compute_true_n(p) - half_width_n(p),
        )
    )
    assert tile.hysteresis_n == pytest.approx(0.9, abs=1e-9)
    # The curve runs through the middle, so the half width is left.
    gauge_kpa = np.linspace(0.0, FULL_KPA, 60)
    assert np.abs(compute_fitted_n(tile, gauge_kpa) - compute_true_n(gauge_kpa)).max() < 1e-9
    left_n = half_width_n(gauge_kpa)
    assert tile.rmse_n == pytest.approx(np.sqrt((left_n**2).mean()), rel=1e-9)
    both_n = np.concatenate(
        [compute_true_n(gauge_kpa) + left_n, compute_true_n(gauge_kpa) - left_n]
    )
    assert tile.r2 == pytest.approx(1 - (left_n**2).mean() / both_n.var(), rel=1e-12)


def test_the_error_of_a_repeat_is_that_of_predicting_it_from_the_others() -> None:
    # Repeats whose force is the curve times 0.97, 1.00, 1.00 and 1.03: leaving one out, the others'
    # mean gain is off by 0.04, 0, 0 and 0.04.
    gains = (0.97, 1.0, 1.0, 1.03)
    tile = fit_static_curve(record(gains=gains))
    strokes_n = compute_true_n(np.linspace(0.0, FULL_KPA, 60))
    rms_n = np.sqrt((strokes_n**2).mean())
    assert tile.cv_rmse_n == pytest.approx(np.sqrt(2 * 0.04**2 / 4) * rms_n, rel=1e-6)
    assert tile.relative_misfit == pytest.approx(np.sqrt(2 * 0.04**2 / 4), rel=0.01)
    assert tile.loop_misfit_n < 0.02  # all scatter is gain
    assert tile.rmse_n == pytest.approx(np.sqrt(2 * 0.03**2 / 4) * rms_n, rel=1e-6)


def test_a_loop_and_different_gains_are_distinguished() -> None:
    # Branches 0.3 N times F / (F + 1 N) above and below the curve, in repeats that differ by 4 %
    # as above: both kinds of scatter are found, each as what it is.
    def opening_n(p: np.ndarray) -> np.ndarray:
        return 0.3 * compute_true_n(p) / (compute_true_n(p) + 1.0)

    tile = fit_static_curve(
        record(
            load=lambda p: compute_true_n(p) + opening_n(p),
            unload=lambda p: compute_true_n(p) - opening_n(p),
            gains=(0.97, 1.0, 1.0, 1.03),
        )
    )
    assert tile.loop_misfit_n == pytest.approx(0.3, rel=0.05)
    assert tile.relative_misfit == pytest.approx(np.sqrt(2 * 0.04**2 / 4), rel=0.05)


def test_the_covariance_is_that_of_a_mean_over_repeats() -> None:
    # The jackknife of a mean is its variance: var(gain) / repeats, along the curve itself.
    gains = (0.97, 1.0, 1.01, 1.03, 0.96)
    tile = fit_static_curve(record(gains=gains))
    sigma = np.std(gains, ddof=1) / np.sqrt(len(gains))
    c = np.array(tile.coefficients[1:])
    expected = sigma**2 * np.outer(c, c) / np.mean(gains) ** 2
    np.testing.assert_allclose(tile.covariance, expected, rtol=1e-6, atol=1e-12)


def test_the_noise_on_the_rig_is_of_a_single_reading() -> None:
    tile = fit_static_curve(record(noise_kpa=0.165, readings=600))
    assert tile.noise_kpa == pytest.approx(0.165, rel=0.35)  # of 40 readings


def compute_dip_n(gauge_kpa: np.ndarray) -> np.ndarray:
    x = gauge_kpa / FULL_KPA
    return np.asarray(9 * x - 24 * x**2 + 20 * x**3)  # slope -0.6 at x = 0.4


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"load": lambda p: 0.3 * p / FULL_KPA}, r"never loads the tile: at most 0\.30 N"),
        ({"load": lambda p: 60 * p, "full_kpa": 0.5}, r"never loads the tile.*0\.50 kPa.*sealed"),
        ({"load": compute_dip_n}, r"bench\.parquet, tile T01.*not monotonic"),
        ({"gains": ()}, "never presses this tile"),
        ({"gains": (1.0,)}, "1 slow repeat; expected at least two"),
    ],
    ids=["no force", "no pressure", "a falling curve", "no press", "one repeat"],
)
def test_a_recording_without_a_curve_is_refused(changes: dict[str, Any], match: str) -> None:
    with pytest.raises(CalibrationError, match=match):
        fit_static_curve(record(**changes))


def test_the_range_ends_at_the_mean_end_of_the_repeats() -> None:
    # Gain on the pressure axis: the same forces at 4 % more pressure in half of the repeats.
    low, high = record(gains=(1.0,)), record(gains=(1.0,), full_kpa=1.04 * FULL_KPA)
    columns = ("kpa", "reference_n", "phase", "is_under_indenter", "temperature_raw")
    joined: dict[str, Any] = {
        name: np.append(getattr(low, name), getattr(high, name)) for name in columns
    }
    t_ns = np.append(low.t_ns, low.t_ns[-1] + 2_000_000 + high.t_ns)
    both = replace(low, t_ns=t_ns, **joined)
    assert fit_static_curve(both).range_kpa == pytest.approx((0.0, 1.02 * FULL_KPA))
