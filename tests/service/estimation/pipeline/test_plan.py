"""The constants of an estimate, and refusals before the first frame."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from devices.errors import CalibrationError, FootTileError, UsageError
from service.estimation.calibration import make_paper_shape_preset
from service.estimation.pipeline.plan import make_plan
from tests.builders.arrays import COUNT_KPA, DATA_SHEET_CHIP, array_at
from tests.builders.calibrations import newton_tile
from tests.builders.estimates import newton_plan

LINE = [(0.0, 0.0, -0.15), (0.014, 0.0, -0.15), (0.028, 0.0, -0.15)]
INFO = array_at(LINE)


def test_contact_thresholds_are_five_and_three_sigma_of_the_unloaded_sum() -> None:
    # three tiles of 0.5 N each: sqrt(3) * 0.5
    rule = newton_plan(INFO, sigma_n=0.5).params.foot
    assert [*rule["contact_on_n"], *rule["contact_off_n"]] == pytest.approx(
        np.array([5, 3]) * 0.5 * np.sqrt(3)
    )
    assert rule["contact_min_ns"] == 10_000_000
    plan = newton_plan(INFO, sigma_n=0.3)
    tare = replace(plan.tare, baseline_sigma_kpa=np.full(3, 0.4 * COUNT_KPA))
    uncertain = make_plan(plan.info, plan.calibration, tare, models=plan.models)
    on_n = uncertain.params.foot["contact_on_n"]
    assert on_n == pytest.approx(rule["contact_on_n"]), "0.3 N and 0.4 N of the baseline"
    quiet = newton_plan(INFO, sigma_n=0.001).params
    floor_n = 0.06 / COUNT_KPA  # what the rubber keeps of a load is no contact
    assert quiet.foot["contact_off_n"] == pytest.approx(3 * floor_n * np.sqrt(3))
    assert quiet.tiles["range_low_kpa"] == pytest.approx(-5 * 0.06)


def test_a_reference_tile_is_in_no_sum_no_hull_and_no_grid() -> None:
    plan = newton_plan(array_at([*LINE, (0.5, 0.5, -0.15)], references=[3]), sigma_n=0.5)
    assert plan.load_bearing_columns.tolist() == [0, 1, 2]
    assert plan.params.tiles["is_load_bearing"].tolist() == [1, 1, 1, 0]
    foot, without = plan.params.foot, newton_plan(INFO, sigma_n=0.5).params.foot
    assert foot["n_load_bearing"] == 3
    assert foot["contact_on_n"] == without["contact_on_n"]
    assert sorted(plan.params.hull[:, 2].tolist()) == pytest.approx([0.0, 0.028])
    assert foot["has_grid"] == 1
    assert plan.load_bearing_params["grid_index"][:, 0].tolist() == [1.0, 2.0, 3.0]


def test_options_are_in_ladder_order_nanoseconds_and_periods() -> None:
    plan = newton_plan(INFO, models=["static", "unwrap"], lag_ms=9.2)
    assert (plan.models, plan.lag_ns) == (("unwrap", "static"), 9_200_000)
    assert plan.params.foot["gap_ns"] == 3_000_000, (
        "a frame one and a half periods late comes after a gap"
    )


def test_one_assumed_scale_makes_the_whole_sum_assumed() -> None:
    paper = make_paper_shape_preset().tiles[0].model_copy(update={"serial": "T02"})
    tiles = [newton_tile("T01"), paper, newton_tile("T03")]
    assert newton_plan(INFO, tiles=tiles).is_scale_assumed
    assert not newton_plan(INFO).is_scale_assumed


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
def test_an_impossible_option_is_refused_by_name(options: dict[str, Any], named: str) -> None:
    with pytest.raises(UsageError, match=named):
        newton_plan(INFO, **options)


def test_a_tile_without_calibration_is_refused_by_serial() -> None:
    with pytest.raises(CalibrationError, match="T03"):
        newton_plan(INFO, tiles=[newton_tile("T01"), newton_tile("T02")])


def test_another_chip_under_the_same_serial_is_refused() -> None:
    chips = [DATA_SHEET_CHIP] * 3
    own = [newton_tile(serial, registers=chips[0]) for serial in INFO.serials]
    assert newton_plan(array_at(LINE, chips=chips), tiles=own).calibration.tiles == tuple(own)
    chips[1] = (0x3ECE, 0xB3F9, 0xC517, 0x33C4)
    with pytest.raises(CalibrationError, match="T02 is not the part that was calibrated"):
        newton_plan(array_at(LINE, chips=chips), tiles=own)
    for_any_chip = newton_plan(array_at(LINE, chips=chips))
    assert for_any_chip.load_bearing_columns.tolist() == [0, 1, 2]


def test_an_array_of_reference_tiles_is_refused() -> None:
    with pytest.raises(FootTileError):
        newton_plan(array_at(LINE, references=[0, 1, 2]))
