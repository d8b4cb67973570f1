"""The metric, on cases small enough to be worked out by hand."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest

from devices.flags import EstimateFlag
from service.json_output import to_json_value
from service.offline.accuracy import (
    ACCURACY_COLUMNS,
    PHASES,
    Accuracy,
    CoverageCount,
    classify_phases,
    compute_accuracy,
)

PERIOD_NS = 10_000_000


def columns(true_n: list[float], **given: Any) -> dict[str, np.ndarray]:
    """Perfect estimates of these forces, 10 ms apart, with changes."""
    n = len(true_n)
    made: dict[str, Any] = {
        "t_ns": 1_577_836_800_000_000_000 + PERIOD_NS * np.arange(n, dtype=np.int64),
        "true_grf_n": true_n,
        "grf_n": true_n,
        "grf_sigma_n": np.full(n, 0.1),
        "true_cop_x_m": np.zeros(n),
        "true_cop_y_m": np.zeros(n),
        "cop_x_m": np.zeros(n),
        "grf_lower_bound_n": np.full(n, np.nan),
        "cop_y_m": np.zeros(n),
        "cop_sigma_x_m": np.full(n, 0.001),
        "estimate_flags": np.zeros(n, dtype=np.uint16),
    }
    assert set(made) == set(ACCURACY_COLUMNS)
    return {name: np.asarray(values) for name, values in (made | given).items()}


def test_error_is_counted_under_load_only() -> None:
    # 0.5 N is no load yet; errors of 0.3, -0.1 and 0.2 N under it
    a = compute_accuracy(columns([0.0, 0.5, 0.6, 5.0, 10.0], grf_n=[9.0, 9.0, 0.9, 4.9, 10.2]))
    assert (a.frames, a.grf_frames) == (5, 3)
    assert a.grf_mae_n == pytest.approx(0.2)
    assert a.grf_bias_n == pytest.approx(0.4 / 3)
    assert a.grf_rms_n == pytest.approx(math.sqrt((0.09 + 0.01 + 0.04) / 3))


def test_saturated_and_missing_frames_are_not_judged_and_saturated_ones_are_counted() -> None:
    status = [EstimateFlag.SATURATED | EstimateFlag.GAP, EstimateFlag.TILE_MISSING, 0]
    a = compute_accuracy(
        columns([50.0, 10.0, 10.0], grf_n=[30.0, np.nan, 10.5], estimate_flags=status)
    )
    assert (a.grf_frames, a.saturated_frames) == (1, 1)
    assert a.grf_mae_n == pytest.approx(0.5)


def test_bounds_are_counted_where_they_are_all_that_is_known() -> None:
    nan = np.nan
    a = compute_accuracy(
        columns([10.0] * 4, grf_n=[10.0, nan, nan, nan], grf_lower_bound_n=[99.0, 9.0, 11.0, nan])
    )
    assert a.bounds == CoverageCount(2, 1)


def test_frames_after_saturation_are_counted_among_the_others_and_by_themselves() -> None:
    after = EstimateFlag.AFTER_SATURATION
    status = [after | EstimateFlag.SATURATED, after, after, after, 0]
    grf_n = [9.0, 10.1, 10.4, np.nan, 10.0]
    a = compute_accuracy(columns([10.0] * 5, grf_n=grf_n, estimate_flags=status))
    assert a.grf_frames == 3
    assert a.after_saturation == CoverageCount(2, 1)
    assert a.after_saturation_mae_n == pytest.approx(0.25)


def test_coverage_is_the_part_within_1_96_sigma() -> None:
    grf_n = [10.195, 9.805, 10.197, 10.0]  # 1.96 sigma is 0.196 N
    a = compute_accuracy(columns([10.0] * 4, grf_n=grf_n))
    assert a.grf_coverage_95 == pytest.approx(0.75)


def test_the_median_of_sigma_is_that_of_the_judged_frames() -> None:
    a = compute_accuracy(columns([0.0, 10.0, 10.0, 10.0], grf_sigma_n=[9.0, 0.1, 0.3, 0.2]))
    assert a.grf_sigma_median_n == pytest.approx(0.2)


def test_flight_is_where_nothing_presses_at_all_and_its_mean_keeps_its_sign() -> None:
    a = compute_accuracy(columns([0.0, 0.0, 0.0, 0.4], grf_n=[-0.3, 0.1, np.nan, 9.0]))
    assert a.flight_mean_n == pytest.approx(-0.1)


def test_peak_and_impulse_are_judged_per_stance() -> None:
    # 60 ms of 10 N estimated at 11 N: peak off by 1 N, impulse by 0.06 N s. A second stance is
    # estimated 2 N low: 2 N and 0.12 N s. Between them both signs must not cancel.
    true_n = [0.0] * 2 + [10.0] * 7 + [0.0] * 2 + [20.0] * 7 + [0.0]
    grf_n = [0.0] * 2 + [11.0] * 7 + [0.0] * 2 + [18.0] * 7 + [0.0]
    a = compute_accuracy(columns(true_n, grf_n=grf_n))
    assert a.stances == 2
    assert a.peak_error_n == pytest.approx(1.5)
    assert a.impulse_error_ns == pytest.approx((0.06 + 0.12) / 2)


def test_a_peak_is_compared_with_a_peak_wherever_each_lies() -> None:
    true_n = [0.0, 2.0, 4.0, 12.0, 4.0, 4.0, 2.0, 2.0, 0.0]
    grf_n = [0.0, 2.0, 4.0, 4.0, 11.0, 4.0, 2.0, 2.0, 0.0]
    a = compute_accuracy(columns(true_n, grf_n=grf_n))
    assert a.peak_error_n == pytest.approx(1.0)


def test_a_touch_or_a_stance_with_a_hole_is_no_stance() -> None:
    # 40 ms is a touch; 50 ms is a stance; a NaN in it leaves no impulse to compare
    assert compute_accuracy(columns([0.5] + [10.0] * 5 + [0.5])).stances == 0
    assert compute_accuracy(columns([0.0] + [10.0] * 6 + [0.0])).stances == 1
    grf_n = [0.0, 10.0, 10.0, np.nan, 10.0, 10.0, 10.0, 0.0]
    assert compute_accuracy(columns([0.0] + [10.0] * 6 + [0.0], grf_n=grf_n)).stances == 0


def test_a_stance_may_begin_and_end_the_recording() -> None:
    a = compute_accuracy(columns([10.0] * 8, grf_n=[10.5] * 8))
    assert a.stances == 1
    assert a.impulse_error_ns == pytest.approx(0.035)


def test_the_centre_is_judged_by_distance_where_it_is_stated_under_more_than_3_n() -> None:
    # distances of 5 mm (3, 4), 0 and 2 mm from a truth that moves; the frame at 3 N does not count
    a = compute_accuracy(
        columns(
            [3.0, 3.1, 10.0, 10.0],
            true_cop_x_m=[0.0, 0.05, -0.02, 0.02],
            true_cop_y_m=[0.0, 0.01, -0.01, 0.01],
            cop_x_m=[0.9, 0.053, -0.02, 0.022],
            cop_y_m=[0.9, 0.006, -0.01, 0.01],
        )
    )
    assert a.cop_frames == 3
    assert a.cop_mean_m == pytest.approx(0.007 / 3)
    assert a.cop_p95_m == pytest.approx(0.0047)  # linear between 2 mm at 50 % and 5 mm at 100 %
    assert a.cop_masked_frames == 0
    assert a.cop_coverage_95 == pytest.approx(1 / 3)  # 3 mm and 2 mm are beyond 1.96 mm


def test_masked_centres_are_counted_under_load_only() -> None:
    a = compute_accuracy(columns([0.0, 1.0, 10.0, 10.0], cop_x_m=[np.nan, np.nan, np.nan, 0.0]))
    assert (a.cop_frames, a.cop_masked_frames) == (1, 1)


def test_tiles_in_one_row_are_scored_by_the_measured_coordinate_alone() -> None:
    nothing = [np.nan] * 3
    in_y = compute_accuracy(columns([10.0] * 3, cop_x_m=[0.003, np.nan, -0.001], cop_y_m=nothing))
    assert (in_y.cop_frames, in_y.cop_masked_frames) == (2, 1)
    assert in_y.cop_mean_m == pytest.approx(0.002)
    assert in_y.cop_covered == CoverageCount(2, 1)
    sigma = {"cop_sigma_x_m": nothing}
    in_x = compute_accuracy(columns([10.0] * 3, cop_x_m=nothing, cop_y_m=[0.003] * 3, **sigma))
    assert (in_x.cop_frames, in_x.cop_covered) == (3, CoverageCount(0, 0))
    assert in_x.cop_mean_m == pytest.approx(0.003)
    neither = compute_accuracy(columns([10.0] * 3, cop_x_m=nothing, cop_y_m=nothing, **sigma))
    assert (neither.cop_frames, neither.cop_masked_frames) == (0, 3)
    assert math.isnan(neither.cop_mean_m)


def named_phases(true_n: list[float]) -> list[str]:
    t_ns = PERIOD_NS * np.arange(len(true_n), dtype=np.int64)
    return [PHASES[i] for i in classify_phases(t_ns, np.array(true_n))]


def test_phases_are_told_by_the_truth_and_each_stance_by_its_own_peak_and_duration() -> None:
    up, mid, down = ["loading"] * 2, ["mid_stance"] * 6, ["unloading"] * 2
    stance = [5.0, 10.0, 10.0, 10.0, 10.0, 10.0, 10.0, 10.0, 10.0, 5.0]
    flight = ["flight"] * 2
    expected = [*flight, *up, *mid, *down, *flight]
    assert named_phases([0.0, 0.0, *stance, 0.0, 0.0]) == expected
    # A hundredth of the load, as steep for its size, beside the great one
    small = [0.01 * force for force in stance]
    both = named_phases([0.0, 0.0, *stance, 0.0, 0.0, *small, 0.0, 0.0])
    assert both == [*expected, *up, *mid, *down, *flight]


def test_suction_is_no_flight_and_a_recording_may_be_one_stance_or_one_frame() -> None:
    assert named_phases([0.0, -0.1, -0.1, 0.0]).count("flight") == 2
    assert named_phases([10.0] * 5) == ["mid_stance"] * 5
    assert named_phases([10.0]) == ["mid_stance"]
    assert named_phases([0.0]) == ["flight"]


def test_coverage_is_counted_in_each_phase_over_all_unsaturated_frames() -> None:
    true_n = [0.0, 0.0, 5.0, 10.0, 10.0, 10.0, 10.0, 10.0, 10.0, 10.0, 5.0, 0.0]
    grf_n = np.array(true_n)
    grf_n[[1, 2, 5]] += [0.3, -0.3, 0.3]  # 1.96 sigma is 0.196 N
    status = np.zeros(12, dtype=np.uint16)
    status[6] = EstimateFlag.SATURATED
    grf_n[7] = np.nan
    a = compute_accuracy(columns(true_n, grf_n=grf_n, estimate_flags=status))
    assert a.grf_phases == {
        "flight": CoverageCount(3, 2),
        "loading": CoverageCount(2, 1),
        "mid_stance": CoverageCount(3, 2),
        "unloading": CoverageCount(2, 2),
    }
    assert sum((c for c in a.grf_phases.values()), CoverageCount(0, 0)) == CoverageCount(10, 7)


def test_the_share_of_unstated_centres_and_their_coverage_as_counts() -> None:
    a = compute_accuracy(columns([10.0] * 4, cop_x_m=[np.nan, 0.0, 0.001, 0.01]))
    assert a.cop_masked_share == pytest.approx(0.25)
    assert a.cop_covered == CoverageCount(3, 2)


def test_sigma_in_mid_stance_leaves_loading_out() -> None:
    sigma_n = [9.0, 9.0, 9.0, 0.1, 0.2, 0.3, 0.2, 0.2, 9.0, 9.0]
    true_n = [0.0, 5.0, 10.0, 10.0, 10.0, 10.0, 10.0, 10.0, 10.0, 0.0]
    assert compute_accuracy(
        columns(true_n, grf_sigma_n=sigma_n)
    ).grf_sigma_mid_stance_n == pytest.approx(0.2)


def test_a_published_estimate_is_compared_with_the_truth_one_look_ahead_later() -> None:
    true_n = [1.0, 2.0, 3.0, 4.0, 5.0]
    assert compute_accuracy(columns(true_n)).grf_published_mae_n == 0.0
    # 15 ms are a frame and a half; the last two frames are published after the end
    late = compute_accuracy(columns(true_n), lag_ms=15.0)
    assert late.grf_published_mae_n == pytest.approx(1.5)
    assert late.grf_mae_n == 0.0


def test_figures_without_frames_are_nan_and_null_in_json() -> None:
    a = compute_accuracy(columns([0.4, 0.4], cop_x_m=[np.nan, np.nan]))
    assert (a.grf_frames, a.cop_frames, a.stances) == (0, 0, 0)
    figures = to_json_value(a)
    nothing = {name for name, value in figures.items() if value is None}
    assert nothing == {
        "grf_mae_n",
        "grf_rms_n",
        "grf_bias_n",
        "grf_coverage_95",
        "grf_sigma_median_n",
        "grf_published_mae_n",
        "flight_mean_n",
        "flight_mae_n",
        "peak_error_n",
        "impulse_error_ns",
        "cop_mean_m",
        "cop_p95_m",
        "cop_coverage_95",
        "cop_masked_share",
        "after_saturation_mae_n",
    }
    assert figures["grf_phases"]["loading"] == {"frames": 0, "within": 0, "coverage_95": None}
    assert json.loads(json.dumps(figures, allow_nan=False))["frames"] == 2


def test_a_perfect_estimate_is_perfect() -> None:
    a = compute_accuracy(columns([0.0] * 5 + [10.0] * 10))
    expected = {
        "grf_mae_n": 0.0,
        "grf_bias_n": 0.0,
        "grf_coverage_95": 1.0,
        "flight_mean_n": 0.0,
        "peak_error_n": 0.0,
        "impulse_error_ns": 0.0,
        "cop_p95_m": 0.0,
        "cop_coverage_95": 1.0,
    }
    assert isinstance(a, Accuracy)
    assert {name: getattr(a, name) for name in expected} == expected
