"""The constants of an estimate, and what is refused before the first frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from devices.errors import CalibrationError, FootTileError, UsageError
from devices.frames import ArrayInfo
from service.estimation.calibration import TileCalibration, paper_eq2_shape
from service.estimation.plan import EstimationPlan, make_plan

InfoOf = Callable[..., ArrayInfo]
PlanOf = Callable[..., EstimationPlan]
TileOf = Callable[..., TileCalibration]

LINE = [(0.0, 0.0, -0.15), (0.014, 0.0, -0.15), (0.028, 0.0, -0.15)]


def test_contact_begins_at_five_sigma_of_the_unloaded_sum_and_ends_at_three(
    info_of: InfoOf, plan_of: PlanOf
) -> None:
    # three tiles of 0.5 N each: sqrt(3) * 0.5
    rule = plan_of(info_of(LINE), sigma_n=0.5).contact
    assert rule.on_n == pytest.approx(5 * 0.5 * np.sqrt(3))
    assert rule.off_n == pytest.approx(3 * 0.5 * np.sqrt(3))
    assert rule.min_ns == 10_000_000


def test_a_reference_tile_is_in_no_sum_no_hull_and_no_grid(
    info_of: InfoOf, plan_of: PlanOf
) -> None:
    plan = plan_of(info_of([*LINE, (0.5, 0.5, -0.15)], references=[3]), sigma_n=0.5)
    assert (plan.bearing.tolist(), plan.references.tolist()) == ([0, 1, 2], [3])
    assert plan.contact.on_n == pytest.approx(5 * 0.5 * np.sqrt(3))
    assert sorted(plan.hull[1].tolist()) == pytest.approx([0.0, 0.028])
    assert plan.grid is not None
    assert plan.grid[0].tolist() == [1.0, 2.0, 3.0]


def test_the_uncertainty_of_the_baseline_raises_the_contact_threshold(
    info_of: InfoOf, plan_of: PlanOf
) -> None:
    plan = plan_of(info_of(LINE[:1]), sigma_n=0.3)
    tare = replace(plan.tare, baseline_sigma_kpa=np.array([0.4 * 130 / 1023]))
    again = make_plan(plan.info, plan.calibration, tare, models=plan.models)
    assert again.contact.on_n == pytest.approx(5 * 0.5)


def test_a_frame_one_and_a_half_periods_late_comes_after_a_gap(
    info_of: InfoOf, plan_of: PlanOf
) -> None:
    assert plan_of(info_of(LINE)).gap_ns == 3_000_000


def test_models_are_taken_in_the_order_of_the_ladder(info_of: InfoOf, plan_of: PlanOf) -> None:
    assert plan_of(info_of(LINE), models=("static", "unwrap")).models == ("unwrap", "static")
    assert plan_of(info_of(LINE), models=["static"]).models == ("static",)


def test_one_assumed_scale_makes_the_whole_sum_assumed(
    info_of: InfoOf, plan_of: PlanOf, tile_of: TileOf
) -> None:
    paper = paper_eq2_shape().tiles[0].model_copy(update={"serial": "T02"})
    tiles = [tile_of("T01"), paper, tile_of("T03")]
    assert plan_of(info_of(LINE), tiles=tiles).assumed_scale
    assert not plan_of(info_of(LINE)).assumed_scale


def test_the_lag_is_kept_in_nanoseconds(info_of: InfoOf, plan_of: PlanOf) -> None:
    assert plan_of(info_of(LINE), lag_ms=9.2).lag_ns == 9_200_000


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"models": ("static", "magic")}, "magic"),
        ({"models": ("static", "Unwrap")}, "Unwrap"),
        ({"models": ("unwrap",)}, "static"),
        ({"models": ()}, "static"),
        ({"lag_ms": -1.0}, "-1"),
        ({"lag_ms": float("nan")}, "nan"),
        ({"lag_ms": float("inf")}, "inf"),
        ({"lag_ms": 1e20}, "1e"),
    ],
)
def test_what_cannot_be_estimated_is_refused_by_name(
    info_of: InfoOf, plan_of: PlanOf, options: dict[str, Any], named: str
) -> None:
    with pytest.raises(UsageError) as caught:
        plan_of(info_of(LINE), **options)
    assert named in str(caught.value)


def test_a_tile_without_calibration_is_refused_by_serial(
    info_of: InfoOf, plan_of: PlanOf, tile_of: TileOf
) -> None:
    with pytest.raises(CalibrationError, match="T03"):
        plan_of(info_of(LINE), tiles=[tile_of("T01"), tile_of("T02")])


def test_another_chip_under_the_same_serial_is_refused(
    info_of: InfoOf, plan_of: PlanOf, tile_of: TileOf
) -> None:
    chips = [(0x3ECE, 0xB3F9, 0xC517, 0x33C8)] * 3
    own = [tile_of(f"T0{i}", coefficient_words=chips[0]) for i in (1, 2, 3)]
    assert plan_of(info_of(LINE, chips=chips), tiles=own).calibration.tiles == tuple(own)
    chips[1] = (0x3ECE, 0xB3F9, 0xC517, 0x33C4)
    with pytest.raises(CalibrationError, match="T02 is not the part that was calibrated"):
        plan_of(info_of(LINE, chips=chips), tiles=own)
    for_any_chip = [tile_of(f"T0{i}") for i in (1, 2, 3)]
    assert plan_of(info_of(LINE, chips=chips), tiles=for_any_chip).bearing.tolist() == [0, 1, 2]


def test_an_array_without_a_tile_that_bears_load_is_refused_with_the_reason(
    info_of: InfoOf, plan_of: PlanOf
) -> None:
    with pytest.raises(FootTileError):
        plan_of(info_of(LINE, references=[0, 1, 2]))
