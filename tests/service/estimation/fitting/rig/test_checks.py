"""What is refused as a basis for a calibration, and what is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from devices.errors import CalibrationError
from service.estimation.fitting.rig.indentation import Indentation
from service.estimation.fitting.static_fit import fit_static_curve

BASELINE_KPA = 100.0
READINGS = 120
REST = 60


def force_n(gauge_kpa: np.ndarray) -> np.ndarray:
    return np.asarray(1.5 * gauge_kpa + 0.05 * gauge_kpa**2)


def bench(
    *,
    gains: tuple[float, ...] = (1.0,) * 4,
    rest_kpa: tuple[float, ...] = (0.0,) * 4,
    full_kpa: float = 13.0,
    baseline_kpa: float = BASELINE_KPA,
    zero_n: float = 0.0,
    where: str = "bench.parquet",
) -> Indentation:
    """Strokes of 13 kPa and 28 N; before each the tile rests at `rest_kpa` above its baseline."""
    way_in = np.linspace(0.0, full_kpa, READINGS)
    kpa, reference, phase = [], [], []
    for gain, at_rest in zip(gains, rest_kpa, strict=False):
        kpa += [np.full(REST, at_rest), way_in, way_in[::-1]]
        reference += [np.zeros(REST), gain * force_n(way_in), gain * force_n(way_in[::-1])]
        phase += ["rest"] * REST + ["load"] * READINGS + ["unload"] * READINGS
    n = len(phase)
    return Indentation(
        serial="T01",
        where=where,
        t_ns=np.arange(n, dtype=np.int64) * 5_000_000,
        kpa=baseline_kpa + np.concatenate(kpa),
        reference_n=zero_n + np.concatenate(reference),
        phase=np.array(phase),
        is_under_indenter=np.ones(n, dtype=bool),
        temperature_raw=np.full(n, 472.0),
    )


def test_a_good_recording_states_where_it_ended_how_warm_and_how_repeats_agreed() -> None:
    facts = fit_static_curve(bench(gains=(0.99, 1.0, 1.0, 1.01))).rig
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


def test_the_band_in_the_file_is_t_based_over_the_repeats() -> None:
    gains = (0.97, 1.0, 1.0, 1.03)
    tile = fit_static_curve(bench(gains=gains))
    assert tile.rig is not None
    last = tile.rig.band_95[-1]
    standard_error = np.std(gains, ddof=1) / 2
    assert last.mean_n == pytest.approx(3.182446 * standard_error * last.force_n, rel=1e-3)
    assert last.new_loading_n > last.mean_n


def test_repeats_of_two_files_count_together_each_above_its_own_zero() -> None:
    one = bench(gains=(0.98, 1.0))
    other = bench(gains=(1.0, 1.02), baseline_kpa=101.5, zero_n=-3.0, where="more.parquet")
    both, single = (
        fit_static_curve(one, other),
        fit_static_curve(bench(gains=(0.98, 1.0, 1.0, 1.02))),
    )
    assert both.repeats == 4
    assert both.rig is not None
    assert both.rig.recordings == 2
    assert both.coefficients == pytest.approx(single.coefficients, rel=1e-9)
    np.testing.assert_allclose(both.covariance, single.covariance, rtol=1e-6, atol=1e-15)
    assert both.baseline_kpa == pytest.approx(100.75)


def test_one_repeat_in_each_of_two_files_is_enough() -> None:
    assert (
        fit_static_curve(bench(gains=(1.0,)), bench(gains=(1.01,), where="more.parquet")).repeats
        == 2
    )


def test_a_repeat_far_from_the_others_is_a_contradiction_that_is_named() -> None:
    with pytest.raises(CalibrationError, match=r"contradict one another: repeat 3 takes \+50 %"):
        fit_static_curve(bench(gains=(1.0, 1.0, 1.5, 1.0)))
    assert fit_static_curve(bench(gains=(1.0, 1.0, 1.2, 1.0))).repeats == 4


def test_a_baseline_that_creeps_away_between_repeats_is_refused_with_its_values() -> None:
    with pytest.raises(
        CalibrationError, match=r"drifts by 0\.60 kPa.*100\.00, 100\.20, 100\.50, 100\.80 kPa"
    ):
        fit_static_curve(bench(rest_kpa=(0.0, 0.2, 0.5, 0.8)))


def test_the_rubbers_settling_after_the_first_repeat_is_no_drift() -> None:
    tile = fit_static_curve(bench(rest_kpa=(0.0, 0.5, 0.52, 0.49)))
    assert tile.rig is not None
    assert tile.rig.baseline_drift_kpa == pytest.approx(0.03)
    with pytest.raises(CalibrationError, match=r"drifts by 1\.20 kPa"):
        fit_static_curve(bench(rest_kpa=(0.0, 1.2, 1.2, 1.2)))


def test_a_reference_that_stands_still_while_pressure_rises_is_saturated() -> None:
    recording = bench()
    limited = replace(recording, reference_n=np.minimum(recording.reference_n, 20.0))
    with pytest.raises(CalibrationError, match=r"stands still at 20\.00 N.*saturated"):
        fit_static_curve(limited)


def test_a_reference_without_readings_at_the_top_is_saturated() -> None:
    # The driver gives no force where the converter is at its rail.
    recording = bench()
    railed = np.where(recording.reference_n > 20.0, np.nan, recording.reference_n)
    with pytest.raises(CalibrationError, match=r"no reading above 19\..*saturated"):
        fit_static_curve(replace(recording, reference_n=railed))


def test_a_reference_of_the_wrong_sign_is_told_from_no_load() -> None:
    recording = bench()
    with pytest.raises(CalibrationError, match=r"falls to -2\d.*Turn the sign"):
        fit_static_curve(replace(recording, reference_n=-recording.reference_n))


def test_too_small_a_range_is_refused() -> None:
    with pytest.raises(CalibrationError, match=r"2\.\d+ kPa in the tile; expected more than"):
        fit_static_curve(bench(full_kpa=2.9))


def test_a_recording_that_no_cubic_describes_is_refused_by_its_r2() -> None:
    recording = bench()
    pressed = recording.phase != "rest"
    jumps_n = pressed * np.random.default_rng(1).normal(0.0, 5.0, len(pressed))
    with pytest.raises(CalibrationError, match=r"R2 = 0\.\d+.*at least 0\.9"):
        fit_static_curve(replace(recording, reference_n=recording.reference_n + jumps_n))


def test_a_chip_that_stands_still_ends_the_range_there() -> None:
    recording = bench()
    clipped = replace(recording, kpa=np.minimum(recording.kpa, BASELINE_KPA + 10.0))
    tile = fit_static_curve(clipped)
    assert tile.rig is not None
    assert tile.rig.ended_by == "chip"
    assert tile.range_kpa[1] == pytest.approx(9.9, abs=0.1)
    assert tile.rig.end_n == pytest.approx(force_n(np.array(9.9)), abs=0.5)


def test_a_chip_that_wrapped_ends_the_range_before_it() -> None:
    recording = bench()
    wrapped = np.where(recording.kpa > BASELINE_KPA + 11.0, np.inf, recording.kpa)
    tile = fit_static_curve(replace(recording, kpa=wrapped))
    assert tile.rig is not None
    assert tile.rig.ended_by == "chip"
    assert tile.range_kpa[1] == pytest.approx(11.0, abs=0.15)
    assert tile.rig.spare_kpa == pytest.approx(4.0, abs=0.15)
