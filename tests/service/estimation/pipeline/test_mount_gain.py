"""A foot that a plate has measured as it is mounted: gains of its tiles, and its shear."""

from __future__ import annotations

import math

import numpy as np
import pytest

from devices.flags import EstimateFlag
from devices.frames import NO_SERVO_COUNTS, ArrayInfo
from service.estimation.calibration import Calibration, MountCalibration, make_paper_shape_preset
from service.estimation.effects import Parameter
from service.estimation.pipeline.plan import make_plan
from service.estimation.records import Estimates
from tests.builders.arrays import array_at, make_servo
from tests.builders.calibrations import newton_tile
from tests.builders.estimates import estimate, newton_plan
from tests.builders.frames import loaded_frames
from tests.service.estimation.feet import held

ARC_RAD = np.array([-0.3, -0.1, 0.1, 0.3])
# A parabola whose slope at its places is the arc's: tiles stand upright on it.
X_M = 0.15 * np.tan(ARC_RAD)
ARC = [(x, 0.0, -0.15 + x**2 / 0.3) for x in X_M.tolist()]
TURN = 2.0 * math.pi / 4096
FORCES_N = np.array([10.0, 20.0, 30.0, 40.0])


def mounted_on(
    array: ArrayInfo, gains: dict[str, Parameter], shear: Parameter | None
) -> Calibration:
    plan = newton_plan(array, tiles=[newton_tile(tile.serial) for tile in array.tiles])
    mounted = MountCalibration(reference="plate", gains=gains, shear=shear)
    return plan.calibration.model_copy(update={"mounted": mounted})


def estimated(
    array: ArrayInfo,
    gains: dict[str, Parameter] | None = None,
    shear: Parameter | None = None,
    *,
    sigma_n: float = 0.0,
    counts: int = 0,
) -> Estimates:
    """Four tiles of an arc under 10, 20, 30 and 40 N."""
    plan = newton_plan(array, sigma_n=sigma_n)
    gains = gains or {"T01": Parameter(value=1.0, sigma=0.0)}
    calibration = mounted_on(array, gains, shear)
    again = make_plan(array, calibration, plan.tare, models=("static",))
    return estimate(again, loaded_frames(held(FORCES_N.tolist()), servo_counts=counts))


def test_a_gain_is_in_the_force_of_its_tile_in_the_grf_and_in_the_centre() -> None:
    e = estimated(array_at(ARC), {"T02": Parameter(value=1.5, sigma=0.0)})
    assert e.force_n[-1] == pytest.approx([10, 30, 30, 40])
    assert e.grf_n[-1] == pytest.approx(110)
    assert e.cop_x_m[-1] == pytest.approx(np.dot(X_M, [10, 30, 30, 40]) / 110)


def test_what_is_uncertain_grows_with_the_gain_and_the_gains_own_doubt_with_the_force() -> None:
    gains = {"T04": Parameter(value=2.0, sigma=0.1)}
    e = estimated(array_at(ARC), gains, Parameter(value=0.0, sigma=0.0), sigma_n=0.5)
    assert e.force_sigma_n[-1] == pytest.approx([0.5, 0.5, 0.5, math.hypot(1.0, 0.1 * 40)])
    assert e.grf_sigma_n[-1] == pytest.approx(math.hypot(math.sqrt(3 * 0.25 + 1.0), 4.0))


@pytest.mark.parametrize("shear", [-1.0, 0.0, 0.7])
@pytest.mark.parametrize("counts", [0, 200, -300])
def test_the_vertical_part_of_a_tile_follows_its_angle_to_the_vertical(
    shear: float, counts: int
) -> None:
    array = array_at(ARC, servo=make_servo(ratio=1.0, zero_counts=0, sign=1))
    e = estimated(array, shear=Parameter(value=shear, sigma=0.0), counts=counts)
    vertical_n = FORCES_N * (1.0 + shear * (1.0 - np.cos(ARC_RAD - counts * TURN)))
    assert e.angle_rad[-1] == pytest.approx(counts * TURN)
    assert e.grf_n[-1] == pytest.approx(vertical_n.sum())
    assert e.cop_x_m[-1] == pytest.approx((vertical_n * X_M).sum() / vertical_n.sum())
    assert e.force_n[-1] == pytest.approx(FORCES_N)


def test_what_is_not_known_of_the_shear_is_all_tiles_doubt_alike() -> None:
    e = estimated(array_at(ARC), shear=Parameter(value=-1.0, sigma=0.2))
    tilted = 1.0 - np.cos(ARC_RAD)
    assert e.grf_sigma_n[-1] == pytest.approx(0.2 * float(np.dot(FORCES_N, tilted)))


def test_without_a_shear_all_that_tilt_could_make_is_in_sigma() -> None:
    e = estimated(array_at(ARC), {"T01": Parameter(value=1.0, sigma=0.0)})
    assert e.grf_n[-1] == pytest.approx(100)
    assert e.grf_sigma_n[-1] == pytest.approx(float(np.dot(FORCES_N, 1.0 - np.cos(ARC_RAD))))


def test_while_the_angle_is_not_known_it_is_as_if_no_plate_had_told_the_shear() -> None:
    array = array_at(ARC, servo=make_servo())
    e = estimated(array, shear=Parameter(value=-1.0, sigma=0.0), counts=NO_SERVO_COUNTS)
    assert e.grf_n[-1] == pytest.approx(100)
    assert e.grf_sigma_n[-1] == pytest.approx(float(np.dot(FORCES_N, 1.0 - np.cos(ARC_RAD))))


@pytest.mark.parametrize("shear", [-1.0, -2.0])
def test_of_a_tile_that_hardly_faces_the_ground_nothing_is_told(shear: float) -> None:
    array = array_at(ARC, servo=make_servo(ratio=1.0, zero_counts=0, sign=1))
    e = estimated(array, shear=Parameter(value=shear, sigma=0.1), counts=1000)  # 88 degrees
    assert np.isnan([e.grf_n[-1], e.grf_sigma_n[-1], e.cop_x_m[-1]]).all()
    assert e.force_n[-1] == pytest.approx(FORCES_N)


def test_newtons_that_a_plate_has_measured_are_assumed_no_more() -> None:
    array = array_at(ARC)
    plan = newton_plan(array, tiles=make_paper_shape_preset().tiles)
    for serials, assumed in ((("T01", "T02", "T03", "T04"), False), (("T01", "T02"), True)):
        gains = {serial: Parameter(value=1.1, sigma=0.01) for serial in serials}
        calibration = make_paper_shape_preset().model_copy(
            update={"mounted": MountCalibration(reference="plate", gains=gains)}
        )
        again = make_plan(array, calibration, plan.tare, models=("static",))
        e = estimate(again, loaded_frames(held([5, 5, 5, 5])))
        flagged = bool(e.estimate_flags[-1] & EstimateFlag.ASSUMED_SCALE)
        assert (again.is_scale_assumed, flagged) == (assumed, assumed)


def test_the_mount_calibration_is_part_of_the_id() -> None:
    calibration = make_paper_shape_preset()
    mounted = calibration.model_copy(
        update={
            "mounted": MountCalibration(
                reference="plate", gains={"T01": Parameter(value=1.1, sigma=0.1)}
            )
        }
    )
    assert mounted.id != calibration.id
    assert Calibration.from_json_verifying_id(mounted.to_json(), where="here") == mounted


@pytest.mark.parametrize(
    ("gains", "shear", "says"),
    [
        ({"T01": Parameter(value=0.01, sigma=0.1)}, None, "T01 has a gain of 0.01"),
        ({"T01": Parameter(value=-1.0, sigma=0.1)}, None, "T01 has a gain of -1"),
        ({}, None, "at least 1"),
        ({"T01": Parameter(value=1.0, sigma=0.1)}, Parameter(value=-4.0, sigma=0.1), "shear of -4"),
    ],
)
def test_a_mount_that_cannot_be_is_refused(
    gains: dict[str, Parameter], shear: Parameter | None, says: str
) -> None:
    with pytest.raises(ValueError, match=says):
        MountCalibration(reference="plate", gains=gains, shear=shear)
