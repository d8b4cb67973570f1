"""Errors against a reference, on cases that can be worked out by hand."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from devices.arrays import Floats
from devices.errors import ComparisonError
from service.offline.compare.error_figures import ComparisonErrors, TrialErrors, compute_errors
from service.offline.compare.paired_frames import (
    PairedFrames,
    Trial,
    TrialMarker,
    average_over_trials,
    pair_frames,
    split_into_trials,
)
from tests.service.offline.compare.sessions import (
    BEGAN_NS,
    HZ,
    columns,
    half_sines,
    reference,
    same_clock,
)

TRUE_N = half_sines([10.0, 12.0, 8.0])
NOISE_N = 0.05 * np.random.default_rng(0).normal(size=len(TRUE_N))


def judged(pairs: PairedFrames, **options: Any) -> TrialErrors:
    (only,) = compute_errors(pairs, [Trial("all", np.ones(len(pairs.t_s), bool))], **options).trials
    return only


def paired(own_n: Floats, theirs_n: Floats = TRUE_N, **options: Any) -> PairedFrames:
    return pair_frames(columns(own_n), reference(theirs_n), same_clock(), **options)


def test_a_constant_error_is_bias_and_mae_and_rmse_and_has_no_limits_of_agreement() -> None:
    found = judged(paired(np.where(TRUE_N > 0.0, TRUE_N + 0.3, 0.0)))
    for name in ("grf_bias_n", "grf_mae_n", "grf_rmse_n"):
        assert found.figures[name] == pytest.approx(0.3)
    assert found.limits_of_agreement_n == pytest.approx((0.3, 0.3))


def test_a_gain_gives_the_r2_and_limits_that_follow_from_it() -> None:
    found = judged(paired(1.1 * TRUE_N))
    loaded_n = TRUE_N[TRUE_N > 0.5]
    scatter = ((loaded_n - loaded_n.mean()) ** 2).sum()
    assert found.figures["grf_r2"] == pytest.approx(1.0 - 0.01 * (loaded_n**2).sum() / scatter)
    half_n = 1.96 * 0.1 * loaded_n.std()
    low_n, high_n = found.limits_of_agreement_n
    assert high_n - low_n == pytest.approx(2.0 * half_n)


def test_a_gain_errs_at_peaks_and_in_impulses_by_its_part_of_them() -> None:
    found = judged(paired(1.1 * TRUE_N))
    assert [one.peak_n for one in found.stances] == pytest.approx([1.0, 1.2, 0.8])
    # Half a sine of half a second: 2/pi of peak times duration.
    impulses = [0.1 * peak * 2.0 / math.pi * 0.5 for peak in (10.0, 12.0, 8.0)]
    assert [one.impulse_n_s for one in found.stances] == pytest.approx(impulses, rel=1e-3)
    assert found.figures["peak_mae_n"] == pytest.approx(1.0)


def test_a_stance_that_is_late_is_late_by_that_at_contact_and_lift_off() -> None:
    late_n = np.roll(TRUE_N, 5)  # 10 ms
    found = judged(paired(late_n))
    assert len(found.stances) == 3
    for one in found.stances:
        assert one.contact_s == pytest.approx(0.01, abs=1e-6)
        assert one.lift_off_s == pytest.approx(0.01, abs=1e-6)
    assert found.figures["contact_bias_s"] == pytest.approx(0.01, abs=1e-6)


def test_a_stance_with_an_unknown_frame_or_that_the_reference_has_not_seen_is_left_out() -> None:
    own_n = TRUE_N.copy()
    own_n[round(0.75 * HZ)] = np.nan
    theirs_n = TRUE_N.copy()
    theirs_n[round(1.4 * HZ) : round(2.1 * HZ)] = 0.0
    found = judged(pair_frames(columns(own_n, contact=(TRUE_N > 0.5).astype(np.uint8)),
                        reference(theirs_n), same_clock()))  # fmt: skip
    assert [one.number for one in found.stances] == [3]
    assert found.stances_left_out == 2


def test_the_reference_zero_is_found_in_flight_and_taken_off_only_if_asked_for() -> None:
    theirs_n = TRUE_N + 1.5 + NOISE_N
    kept = paired(TRUE_N, theirs_n)
    assert kept.reference_zero_n is not None
    low_n, high_n = kept.reference_zero_n.interval_95
    assert low_n < 1.5 < high_n
    assert high_n - low_n < 0.02
    assert judged(kept).figures["grf_bias_n"] == pytest.approx(-1.5, abs=0.02)
    assert len(judged(kept).stances) == 3
    removed = paired(TRUE_N, theirs_n, remove_offset=True)
    assert judged(removed).figures["grf_bias_n"] == pytest.approx(0.0, abs=0.02)


def test_the_scale_is_never_applied() -> None:
    assert judged(paired(TRUE_N, 2.0 * TRUE_N)).figures["grf_mae_n"] > 3.0


def test_contact_of_the_reference_is_five_sigma_of_its_noise_in_flight() -> None:
    pairs = paired(TRUE_N, TRUE_N + 10.0 * NOISE_N)
    assert pairs.contact_threshold_n == pytest.approx(2.5, rel=0.1)
    assert paired(TRUE_N, contact_n=4.0).contact_threshold_n == 4.0


def test_coverage_is_said_only_if_the_reference_says_how_good_it_is() -> None:
    off_n = 0.25 * np.ones(len(TRUE_N))
    assert math.isnan(judged(paired(TRUE_N + off_n)).figures["grf_coverage_95"])
    # 1.96 sqrt(0.1² + s²) is 0.25 N for s = 0.0792 N.
    for sigma_n, part in ((0.07, 0.0), (0.09, 1.0)):
        found = judged(paired(TRUE_N + off_n), reference_sigma_n=sigma_n)
        assert found.figures["grf_coverage_95"] == part
        covered = found.phases["mid_stance"].covered
        assert covered is not None
        assert covered.share == part


def test_the_lag_is_in_the_error_by_the_rate_of_change() -> None:
    ramp_n = np.concatenate([np.zeros(200), np.linspace(0.0, 20.0, 200), np.full(100, 20.0)])
    pairs = pair_frames(columns(ramp_n), reference(ramp_n), same_clock(lag_sigma_s=0.002))
    # 20 N in 0.4 s, half of the loaded frames less one step.
    np.testing.assert_allclose(pairs.lag_sigma_n[210:390], 0.002 * 20.0 / 199 * HZ)
    np.testing.assert_allclose(pairs.lag_sigma_n[410:], 0.0, atol=1e-12)
    late = pair_frames(
        columns(np.roll(ramp_n, 1)), reference(ramp_n), same_clock(lag_sigma_s=0.002)
    )
    sure = pair_frames(columns(np.roll(ramp_n, 1)), reference(ramp_n), same_clock())
    assert judged(late, reference_sigma_n=0.0).figures["grf_coverage_95"] == 1.0
    assert judged(late).figures["grf_lag_n"] > judged(sure).figures["grf_lag_n"] == 0.0


def test_cop_counts_only_where_both_are_in_contact_and_both_counts_are_said() -> None:
    cop_m = np.stack([np.full(len(TRUE_N), 0.007), np.full(len(TRUE_N), -0.016)], axis=1)
    cop_m[TRUE_N < 5.0] = np.nan
    held = reference(TRUE_N, cop_m=cop_m)
    found = judged(pair_frames(columns(TRUE_N), held, same_clock()))
    assert found.figures["cop_mean_m"] == pytest.approx(0.005)  # 3, 4, 5
    assert found.figures["cop_p95_m"] == pytest.approx(0.005)
    assert found.figures["cop_bias_x_m"] == pytest.approx(0.003)
    assert found.figures["cop_p95_about_mean_m"] == pytest.approx(0.0, abs=1e-12)
    assert found.cop_frames["both"] == found.cop_frames["reference"] < found.cop_frames["ours"]


def test_coverage_of_the_cop_is_said_by_axis_if_the_reference_says_how_good_it_is() -> None:
    force_n = half_sines([20.0, 25.0, 22.0])
    off_m = np.random.default_rng(3).normal(0.0, 0.001, (len(force_n), 2))
    there_m = np.array([0.01, -0.02]) + off_m
    for sigma_m, least, most in ((0.0005, 0.6, 0.75), (0.001, 0.93, 0.97)):
        sigmas: dict[str, Any] = {
            f"cop_sigma_{axis}_m": np.full(len(force_n), sigma_m) for axis in "xy"
        }
        pairs = pair_frames(
            columns(force_n, **sigmas), reference(force_n, cop_m=there_m), same_clock()
        )
        trial = judged(pairs, reference_cop_sigma_m=0.0)
        for axis in "xy":
            assert least < trial.figures[f"cop_coverage_{axis}_95"] < most
    assert np.isnan(judged(pairs).figures["cop_coverage_x_95"])


@pytest.mark.parametrize("is_of_before", [False, True])
def test_the_coordinate_across_a_row_of_tiles_is_not_scored(is_of_before: bool) -> None:
    force_n = half_sines([20.0, 25.0])
    n = len(force_n)
    across: dict[str, Any] = {name: np.full(n, np.nan) for name in ("cop_y_m", "cop_sigma_y_m")}
    if is_of_before:  # the row's place, with a sigma of 0
        across = {name: np.zeros(n) for name in across}
    there_m = np.tile([0.009, -0.02], (n, 1))  # ours is at x = 10 mm
    pairs = pair_frames(columns(force_n, **across), reference(force_n, cop_m=there_m), same_clock())
    trial = judged(pairs, reference_cop_sigma_m=0.001)
    assert trial.cop_frames["both"] > 300
    assert trial.figures["cop_mean_m"] == pytest.approx(0.001)
    assert trial.figures["cop_p95_m"] == pytest.approx(0.001)
    assert trial.figures["cop_p95_about_mean_m"] == pytest.approx(0.0, abs=1e-12)
    assert trial.figures["cop_bias_x_m"] == pytest.approx(0.001)
    assert trial.figures["cop_coverage_x_95"] == 1.0
    assert np.isnan(trial.figures["cop_bias_y_m"])
    assert np.isnan(trial.figures["cop_coverage_y_95"])


def test_a_reference_of_50_hz_counts_once_for_each_of_its_samples() -> None:
    slow = reference(TRUE_N[::10], hz=HZ / 10)
    pairs = pair_frames(columns(TRUE_N), slow, same_clock())
    assert len(TRUE_N[::10]) - 1 <= pairs.is_counted.sum() <= len(TRUE_N[::10])


def test_frames_in_a_gap_of_the_reference_are_not_there() -> None:
    whole = reference(TRUE_N)
    kept = (whole.force.t_s < 1.0) | (whole.force.t_s > 1.5)
    cut = reference(TRUE_N)
    cut = type(cut)(type(cut.force)(cut.force.t_s[kept], cut.force.force_n[kept]))
    pairs = pair_frames(columns(TRUE_N), cut, same_clock())
    assert not ((pairs.t_s > 1.001) & (pairs.t_s < 1.499)).any()


# --- trials ---------------------------------------------------------------------------------------


def test_markers_begin_trials_and_frames_before_the_first_are_in_none() -> None:
    t_ns = BEGAN_NS + np.arange(10, dtype=np.int64)
    markers = [TrialMarker("b", BEGAN_NS + 6), TrialMarker("a", BEGAN_NS + 2)]
    trials, what = split_into_trials(t_ns, np.zeros(10, np.uint16), markers)
    assert [(trial.name, trial.rows.sum()) for trial in trials] == [("1: a", 4), ("2: b", 4)]
    assert what == "from marker to marker"


def test_each_part_is_a_trial_if_there_are_no_markers() -> None:
    part = np.array([0, 0, 1, 1, 1], dtype=np.uint16)
    trials, what = split_into_trials(np.arange(5, dtype=np.int64), part, [])
    assert [trial.rows.sum() for trial in trials] == [2, 3]
    assert "contiguous" in what


def test_a_mean_over_few_trials_has_the_interval_of_students_t() -> None:
    # scipy.stats.t.ppf(0.975, 3) is 3.1824; values 1, 2, 3, 4: deviation 1.29099.
    found = average_over_trials(np.array([1.0, 2.0, 3.0, 4.0, np.nan]))
    assert (found.mean, found.trials, found.method) == (2.5, 4, "t")
    assert found.interval_95 == pytest.approx((2.5 - 2.05426, 2.5 + 2.05426), abs=1e-4)


def test_a_mean_over_many_trials_is_resampled_by_trial() -> None:
    values = np.random.default_rng(1).exponential(size=60)
    found = average_over_trials(values)
    assert (found.trials, found.method) == (60, "bootstrap")
    assert found.interval_95 is not None
    low, high = found.interval_95
    error = values.std(ddof=1) / math.sqrt(60)
    assert low < found.mean < high
    assert (high - low) / (2 * 1.96 * error) == pytest.approx(1.0, abs=0.15)


def test_a_single_trial_has_no_interval() -> None:
    assert average_over_trials(np.array([1.0])).interval_95 is None
    assert math.isnan(average_over_trials(np.array([np.nan])).mean)


def test_trials_without_any_frame_of_the_reference_are_refused() -> None:
    pairs = paired(TRUE_N)
    with pytest.raises(ComparisonError, match="no trial has a frame"):
        compute_errors(pairs, [Trial("elsewhere", np.zeros(len(pairs.t_s), bool))])


def test_figures_are_averaged_over_trials_not_frames() -> None:
    own_n = TRUE_N + np.where(np.arange(len(TRUE_N)) < 1.2 * HZ, 1.0, 0.0)
    pairs = paired(own_n)
    rows = pairs.t_s < 1.2
    found: ComparisonErrors = compute_errors(pairs, [Trial("a", rows), Trial("b", ~rows)])
    assert found.figures["grf_bias_n"].mean == pytest.approx(0.5)
