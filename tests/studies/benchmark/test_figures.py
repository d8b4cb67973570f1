"""Medians, ranges, pooled coverage and the front, on numbers small enough to check by hand."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from service.json_output import to_json_value
from service.offline.accuracy import Accuracy, compute_accuracy
from studies.benchmark.draws import DrawResult, list_model_sets
from studies.benchmark.figures import (
    Quantiles,
    find_pareto_front,
    pool_coverage,
    summarize_accuracy,
    summarize_model_sets,
)


def accuracy(error_n: float, frames: int = 20) -> Accuracy:
    """Of a standing foot of 10 N that is estimated off by that much; sigma is 0.1 N."""
    columns = {
        "t_ns": 10_000_000 * np.arange(frames, dtype=np.int64),
        "true_grf_n": np.full(frames, 10.0),
        "grf_n": np.full(frames, 10.0 + error_n),
        "grf_sigma_n": np.full(frames, 0.1),
        "grf_lower_bound_n": np.full(frames, np.nan),
        "true_cop_x_m": np.zeros(frames),
        "true_cop_y_m": np.zeros(frames),
        "cop_x_m": np.full(frames, error_n * 1e-3),
        "cop_y_m": np.zeros(frames),
        "cop_sigma_x_m": np.full(frames, 1e-4),
        "estimate_flags": np.zeros(frames, dtype=np.uint16),
    }
    return compute_accuracy(columns)


def test_a_spread_is_median_and_5_to_95_percent() -> None:
    spread = Quantiles.from_values([float(n) for n in range(101)])
    assert (spread.p5, spread.median, spread.p95, spread.n) == (5.0, 50.0, 95.0, 101)


def test_what_is_not_known_is_left_out_of_a_spread_and_counted() -> None:
    assert Quantiles.from_values([1.0, math.nan, 3.0]).n == 2
    assert Quantiles.from_values([1.0, math.nan, 3.0]).median == 2.0
    assert to_json_value(Quantiles.from_values([])) == {
        "median": None,
        "p5": None,
        "p95": None,
        "n": 0,
    }


def test_figures_with_a_sign_do_not_cancel_over_draws() -> None:
    figures = summarize_accuracy([accuracy(-0.3), accuracy(0.3)])
    assert figures["grf_bias_n"].median == pytest.approx(0.3)
    assert figures["grf_mae_n"].median == pytest.approx(0.3)
    assert math.isnan(figures["flight_mean_n"].median)


def test_coverage_is_pooled_over_frames_and_not_over_draws() -> None:
    coverage = pool_coverage([accuracy(0.1, frames=30), accuracy(0.5, frames=10)])
    assert coverage["all"].share == pytest.approx(0.75)
    assert coverage["mid_stance"] == coverage["all"]
    assert coverage["flight"].frames == 0
    assert coverage["cop_x"].share == pytest.approx(0.75)


def test_a_rung_that_failed_in_one_draw_has_the_figures_of_the_others() -> None:
    ladder = list_model_sets(("unwrap", "static"), all_models=("unwrap", "static"))
    label = ladder[0].label
    both = DrawResult(
        0, 20, {("live", label): accuracy(0.1), ("offline", label): accuracy(0.2)}, ()
    )
    one = replace(both, draw=1, accuracy={("live", label): accuracy(0.3)})
    measured = summarize_model_sets(ladder, [both, one], {("live", label): [5.0, 7.0, 6.0]})
    assert measured["live", label].figures["grf_mae_n"].median == pytest.approx(0.2)
    assert measured["live", label].ns_per_frame.median == 6.0
    assert measured["offline", label].figures["grf_mae_n"].n == 1
    assert measured["offline", label].ns_per_frame.n == 0
    assert measured["live", ladder[1].label].figures["grf_mae_n"].n == 0


def test_a_model_left_out_is_compared_draw_by_draw() -> None:
    ladder = list_model_sets(("unwrap", "static"), all_models=("unwrap", "static"))
    whole, less = (("live", model_set.label) for model_set in ladder)
    draws = [
        DrawResult(0, 20, {whole: accuracy(0.1), less: accuracy(0.3)}, ()),
        DrawResult(1, 20, {whole: accuracy(0.5), less: accuracy(0.8)}, ()),
        DrawResult(2, 20, {less: accuracy(9.0)}, ()),
    ]
    measured = summarize_model_sets(ladder, draws, {})
    more = measured[less].beyond_whole["grf_mae_n"]
    assert more.n == 2
    assert more.median == pytest.approx(0.25)
    assert measured[whole].beyond_whole["cop_p95_m"].median == 0.0


def test_figures_are_json() -> None:
    figures = to_json_value(summarize_accuracy([accuracy(0.1)]))
    assert json.loads(json.dumps(figures, allow_nan=False))["grf_mae_n"]["n"] == 1


def test_the_front_has_the_points_that_no_other_beats() -> None:
    points = [(3.0, 1.0), (1.0, 5.0), (2.0, 5.0), (2.0, 2.0), (4.0, 1.0), (5.0, 0.5)]
    assert find_pareto_front(points) == [1, 3, 0, 5]


def test_what_was_not_measured_is_on_no_front() -> None:
    assert find_pareto_front([(math.nan, 0.0), (1.0, math.nan), (2.0, 2.0)]) == [2]
    assert find_pareto_front([]) == []
