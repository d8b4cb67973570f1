"""Checks of rig recordings before a calibration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from devices.chips.mpl115a2 import MPL115A2
from devices.errors import CalibrationError
from service.estimation.fitting.rig.indentation import Indentation
from service.estimation.fitting.static_fit import fit_static_curve

BASELINE_KPA = 100.0
READINGS = 120
REST = 60


def compute_force_n(gauge_kpa: np.ndarray) -> np.ndarray:
    return np.asarray(1.5 * gauge_kpa + 0.05 * gauge_kpa**2)


def record(
    *,
    gains: tuple[float, ...] = (1.0,) * 4,
    rest_kpa: tuple[float, ...] = (0.0,) * 4,
    full_kpa: float = 13.0,
    baseline_kpa: float = BASELINE_KPA,
    zero_n: float = 0.0,
    where: str = "bench.parquet",
) -> Indentation:
    """Record strokes of 13 kPa and 28 N, each from `rest_kpa` above the baseline."""
    way_in = np.linspace(0.0, full_kpa, READINGS)
    kpa, reference, phase = [], [], []
    for gain, at_rest in zip(gains, rest_kpa, strict=False):
        kpa += [np.full(REST, at_rest), way_in, way_in[::-1]]
        reference += [
            np.zeros(REST),
            gain * compute_force_n(way_in),
            gain * compute_force_n(way_in[::-1]),
        ]
        phase += ["rest"] * REST + ["load"] * READINGS + ["unload"] * READINGS
    n = len(phase)
    return Indentation(
        chip=MPL115A2,
        serial="T01",
        where=where,
        t_ns=np.arange(n, dtype=np.int64) * 5_000_000,
        kpa=baseline_kpa + np.concatenate(kpa),
        reference_n=zero_n + np.concatenate(reference),
        phase=np.array(phase),
        is_under_indenter=np.ones(n, dtype=bool),
        temperature_raw=np.full(n, 472.0),
    )


def test_a_good_recording_has_its_facts() -> None:
    facts = fit_static_curve(record(gains=(0.99, 1.0, 1.0, 1.01))).rig
    assert facts is not None
    assert facts.end_absolute_kpa == pytest.approx(113.0, abs=0.2)
    assert facts.spare_kpa == pytest.approx(2.0, abs=0.2)
    assert facts.ended_by == "load"
    assert facts.end_n == pytest.approx(28.0, abs=0.5)
    assert (facts.temperature_raw_counts, facts.degc) == (
        472.0,
        25.0,
    )  # data sheet: 472 counts at 25 degC
    assert facts.repeat_gains == pytest.approx((0.99, 1.0, 1.0, 1.01), abs=1e-3)
    assert facts.r2_of_mean > 0.9999
    assert facts.recordings == 1
    assert [point.gauge_kpa for point in facts.band_95][::10] == pytest.approx(
        [0.0, facts.end_absolute_kpa - BASELINE_KPA]
    )
    assert facts.band_95[0].mean_n == facts.band_95[0].new_loading_n == 0.0


def test_repeats_of_two_files_are_fitted_together_from_their_own_zeros() -> None:
    one = record(gains=(0.98, 1.0))
    other = record(gains=(1.0, 1.02), baseline_kpa=101.5, zero_n=-3.0, where="more.parquet")
    both, single = (
        fit_static_curve(one, other),
        fit_static_curve(record(gains=(0.98, 1.0, 1.0, 1.02))),
    )
    assert both.repeats == 4
    assert both.rig is not None
    assert both.rig.recordings == 2
    assert both.coefficients == pytest.approx(single.coefficients, rel=1e-9)
    np.testing.assert_allclose(both.covariance, single.covariance, rtol=1e-6, atol=1e-15)
    assert both.baseline_kpa == pytest.approx(100.75)


def test_one_repeat_in_each_of_two_files_is_enough() -> None:
    more = record(gains=(1.01,), where="more.parquet")
    assert fit_static_curve(record(gains=(1.0,)), more).repeats == 2


def test_a_repeat_far_from_the_others_is_refused() -> None:
    with pytest.raises(CalibrationError, match=r"contradict one another: repeat 3 takes \+50 %"):
        fit_static_curve(record(gains=(1.0, 1.0, 1.5, 1.0)))
    assert fit_static_curve(record(gains=(1.0, 1.0, 1.2, 1.0))).repeats == 4


def test_a_drifting_baseline_is_refused_with_its_values() -> None:
    with pytest.raises(
        CalibrationError, match=r"drifts by 0\.60 kPa.*100\.00, 100\.20, 100\.50, 100\.80 kPa"
    ):
        fit_static_curve(record(rest_kpa=(0.0, 0.2, 0.5, 0.8)))


def test_settling_after_the_first_repeat_is_no_drift() -> None:
    tile = fit_static_curve(record(rest_kpa=(0.0, 0.5, 0.52, 0.49)))
    assert tile.rig is not None
    assert tile.rig.baseline_drift_kpa == pytest.approx(0.03)
    with pytest.raises(CalibrationError, match=r"drifts by 1\.20 kPa"):
        fit_static_curve(record(rest_kpa=(0.0, 1.2, 1.2, 1.2)))


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda f: np.minimum(f, 20.0), r"stands still at 20\.00 N.*saturated"),
        # The driver gives no force where the converter is at its rail.
        (lambda f: np.where(f > 20.0, np.nan, f), r"no reading above 19\..*saturated"),
        (lambda f: -f, r"falls to -2\d.*Turn the sign"),
        (
            lambda f: f + (f > 0) * np.random.default_rng(1).normal(0.0, 5.0, len(f)),
            r"R2 = 0\.\d+.*at least 0\.9",
        ),
    ],
    ids=["clipped", "at its rail", "of the wrong sign", "no cubic"],
)
def test_a_bad_reference_is_refused(change: Callable[[np.ndarray], np.ndarray], match: str) -> None:
    recording = record()
    with pytest.raises(CalibrationError, match=match):
        fit_static_curve(replace(recording, reference_n=change(recording.reference_n)))


def test_too_small_a_range_is_refused() -> None:
    with pytest.raises(CalibrationError, match=r"2\.\d+ kPa in the tile; expected more than"):
        fit_static_curve(record(full_kpa=2.9))


@pytest.mark.parametrize(
    ("change", "end_kpa", "spare_kpa"),
    [
        (lambda kpa: np.minimum(kpa, BASELINE_KPA + 10.0), 9.9, 5.1),
        (lambda kpa: np.where(kpa > BASELINE_KPA + 11.0, np.inf, kpa), 11.0, 4.0),
    ],
    ids=["stands still", "wraps"],
)
def test_a_chip_at_its_end_ends_the_range(
    change: Callable[[np.ndarray], np.ndarray], end_kpa: float, spare_kpa: float
) -> None:
    recording = record()
    tile = fit_static_curve(replace(recording, kpa=change(recording.kpa)))
    assert tile.rig is not None
    assert tile.rig.ended_by == "chip"
    assert end_kpa - 0.15 <= tile.range_kpa[1] <= end_kpa + 0.1
    assert tile.rig.spare_kpa == pytest.approx(spare_kpa, abs=0.15)
    assert tile.rig.end_n == pytest.approx(compute_force_n(np.array(end_kpa)), abs=0.5)
