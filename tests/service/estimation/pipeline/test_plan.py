"""The constants of an estimate, and what is refused before the first frame."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from devices.errors import CalibrationError, FootTileError, UsageError
from service.estimation.calibration import make_paper_shape_preset
from service.estimation.pipeline.plan import make_plan
from tests.builders.arrays import DATA_SHEET_CHIP, array_at
from tests.builders.calibrations import newton_tile
from tests.builders.estimates import newton_plan

LINE = [(0.0, 0.0, -0.15), (0.014, 0.0, -0.15), (0.028, 0.0, -0.15)]


def test_contact_begins_at_five_sigma_of_the_unloaded_sum_and_ends_at_three() -> None:
    # three tiles of 0.5 N each: sqrt(3) * 0.5
    rule = newton_plan(array_at(LINE), sigma_n=0.5).contact
    assert rule.on_n == pytest.approx(5 * 0.5 * np.sqrt(3))
    assert rule.off_n == pytest.approx(3 * 0.5 * np.sqrt(3))
    assert rule.min_ns == 10_000_000


def test_a_reference_tile_is_in_no_sum_no_hull_and_no_grid() -> None:
    plan = newton_plan(array_at([*LINE, (0.5, 0.5, -0.15)], references=[3]), sigma_n=0.5)
    assert (plan.load_bearing_columns.tolist(), plan.reference_columns.tolist()) == ([0, 1, 2], [3])
    assert plan.contact.on_n == pytest.approx(5 * 0.5 * np.sqrt(3))
    assert sorted(plan.hull[1].tolist()) == pytest.approx([0.0, 0.028])
    assert plan.grid is not None
    assert plan.grid[0].tolist() == [1.0, 2.0, 3.0]


def test_the_uncertainty_of_the_baseline_raises_the_contact_threshold() -> None:
    plan = newton_plan(array_at(LINE[:1]), sigma_n=0.3)
    tare = replace(plan.tare, baseline_sigma_kpa=np.array([0.4 * 130 / 1023]))
    again = make_plan(plan.info, plan.calibration, tare, models=plan.models)
    assert again.contact.on_n == pytest.approx(5 * 0.5)


def test_a_frame_one_and_a_half_periods_late_comes_after_a_gap() -> None:
    assert newton_plan(array_at(LINE)).gap_ns == 3_000_000


def test_models_are_taken_in_the_order_of_the_ladder() -> None:
    assert newton_plan(array_at(LINE), models=("static", "unwrap")).models == ("unwrap", "static")
    assert newton_plan(array_at(LINE), models=["static"]).models == ("static",)


def test_one_assumed_scale_makes_the_whole_sum_assumed() -> None:
    paper = make_paper_shape_preset().tiles[0].model_copy(update={"serial": "T02"})
    tiles = [newton_tile("T01"), paper, newton_tile("T03")]
    assert newton_plan(array_at(LINE), tiles=tiles).is_scale_assumed
    assert not newton_plan(array_at(LINE)).is_scale_assumed


def test_the_lag_is_kept_in_nanoseconds() -> None:
    assert newton_plan(array_at(LINE), lag_ms=9.2).lag_ns == 9_200_000


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
def test_what_cannot_be_estimated_is_refused_by_name(options: dict[str, Any], named: str) -> None:
    with pytest.raises(UsageError) as caught:
        newton_plan(array_at(LINE), **options)
    assert named in str(caught.value)


def test_a_tile_without_calibration_is_refused_by_serial() -> None:
    with pytest.raises(CalibrationError, match="T03"):
        newton_plan(array_at(LINE), tiles=[newton_tile("T01"), newton_tile("T02")])


def test_another_chip_under_the_same_serial_is_refused() -> None:
    chips = [DATA_SHEET_CHIP] * 3
    own = [newton_tile(f"T0{i}", coefficient_words=chips[0]) for i in (1, 2, 3)]
    assert newton_plan(array_at(LINE, chips=chips), tiles=own).calibration.tiles == tuple(own)
    chips[1] = (0x3ECE, 0xB3F9, 0xC517, 0x33C4)
    with pytest.raises(CalibrationError, match="T02 is not the part that was calibrated"):
        newton_plan(array_at(LINE, chips=chips), tiles=own)
    for_any_chip = [newton_tile(f"T0{i}") for i in (1, 2, 3)]
    assert newton_plan(
        array_at(LINE, chips=chips), tiles=for_any_chip
    ).load_bearing_columns.tolist() == [
        0,
        1,
        2,
    ]


def test_an_array_without_a_tile_that_bears_load_is_refused_with_the_reason() -> None:
    with pytest.raises(FootTileError):
        newton_plan(array_at(LINE, references=[0, 1, 2]))
