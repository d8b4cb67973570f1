"""Quantiles over arrays, coverage that is pooled, and models that tiles lose or are given."""

from __future__ import annotations

import math

import pytest

from studies.broad.figures import (
    compare_errors_with_goals,
    compare_uncertainty_with_goals,
    compare_with_goals,
    count_false_alarms,
    count_models,
    summarize_cases,
)
from studies.broad.results import PhaseCounts
from tests.studies.broad.kept import TILE, judged, result


def test_errors_are_quantiles_over_arrays_without_their_signs() -> None:
    rows = summarize_cases(
        [result(n, grf_mae_n=0.01 * n, flight_mean_n=-0.01 * n) for n in range(101)]
    )
    first = rows[0]
    assert (first.scene, first.condition, first.mode) == ("rolling", "clean", "live")
    for name in ("grf_mae_n", "flight_mean_n"):
        assert first.errors[name].median == pytest.approx(0.5)
        assert first.errors[name].p95 == pytest.approx(0.95)
    assert len(rows) == 2 * (3 * 4 + 1)


def test_coverage_is_pooled_over_frames_and_its_worst_is_of_arrays() -> None:
    few = PhaseCounts(frames=10, within=0, sigma2=0.1, error2=0.4)
    bad = judged().phases | {"loading": few}
    row = summarize_cases([result(), result(phases=bad)])[0]
    assert row.coverage["loading"].share == pytest.approx(95 / 110)
    assert row.coverage["all"].share == pytest.approx((380 + 285) / (400 + 310))
    assert row.coverage_of_arrays["loading"].p5 == pytest.approx(0.05 * 0.95)
    assert row.sigma_over_rms["loading"].median == pytest.approx((1.0 + 0.5) / 2)


def test_an_array_that_gave_nothing_in_a_scene_is_not_counted_there() -> None:
    silent = result().model_copy(update={"judged": {}})
    assert summarize_cases([result(), silent])[0].errors["grf_mae_n"].n == 1
    assert summarize_cases([silent]) == []


def test_false_alarms_are_those_of_live_estimates_and_none_within_three_hours_are_below_one() -> (
    None
):
    # 13 recordings an array; of none the limit is -ln(0.05) within the hours there are.
    hours = count_false_alarms([result(seconds=36.0)] * 25)
    assert hours.count == 0
    assert hours.hours == pytest.approx(3.25)
    assert hours.upper_limit_per_hour == pytest.approx(-math.log(0.05) / 3.25)
    (goal,) = [
        g
        for g in compare_errors_with_goals([result(alarms=2, seconds=36.0)])
        if "false alarms" in g.figure
    ]
    assert "26 within 0.1 hours" in goal.figure
    assert not goal.is_met


def test_a_tile_loses_a_model_only_if_its_effect_is_too_great_to_do_without() -> None:
    without = TILE.model_copy(update={"given": ("rubber", "temperature")})
    counted = {m.name: m for m in count_models([result(tiles=(TILE, without))])}
    assert (counted["gas"].needed, counted["gas"].lost) == (2, 1)
    assert (counted["hysteresis"].needed, counted["hysteresis"].lost) == (0, 0)
    assert (counted["temperature"].needed, counted["temperature"].lost) == (2, 0)


def test_a_tile_without_an_effect_that_is_given_its_model_is_counted() -> None:
    nothing = {**TILE.effect_n, "rubber": 0.0}
    rigid = TILE.model_copy(update={"effect_n": nothing, "lacks": ("rubber",)})
    (rubber,) = [m for m in count_models([result(tiles=(rigid,))]) if m.name == "rubber"]
    assert (rubber.needed, rubber.lacking, rubber.invented) == (0, 1, 1)


def test_what_is_good_meets_every_goal_and_what_is_not_misses_its_own() -> None:
    given = ("gas", "rubber", "temperature")
    good = result(tiles=(TILE, TILE.model_copy(update={"lacks": ("hysteresis",), "given": given})))
    assert [goal.figure for goal in compare_with_goals([good]) if not goal.is_met] == []
    bad = result(tiles=good.tiles, grf_mae_n=0.6, wrongly=3)
    missed = {goal.figure for goal in compare_errors_with_goals([bad]) if not goal.is_met}
    assert "mud: GRF mean absolute error, N, median" in missed
    assert all("GRF mean absolute error" in figure for figure in missed)
    wrongly = [goal for goal in compare_uncertainty_with_goals([bad]) if not goal.is_met]
    assert {goal.value for goal in wrongly} == {3.0}
    assert len(wrongly) == len(summarize_cases([bad]))


def test_a_tile_that_its_bench_refuses_is_counted_among_all_that_were_pressed() -> None:
    refused = result().model_copy(update={"judged": {}, "tiles": (), "tiles_refused": 1})
    (goal,) = [g for g in compare_errors_with_goals([refused, result()]) if "refused" in g.figure]
    assert goal.value == pytest.approx(100 / 8)
    assert not goal.is_met


def test_without_arrays_nothing_is_met() -> None:
    goals = compare_with_goals([])
    assert goals
    assert all(math.isnan(goal.value) and not goal.is_met for goal in goals)
