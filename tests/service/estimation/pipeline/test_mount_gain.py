"""A foot that a plate has measured as mounted: gains of its tiles, and its shear."""

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
from tests.builders.estimates import newton_plan
from tests.service.estimation.feet import estimate_load

ARC_RAD = np.array([-0.3, -0.1, 0.1, 0.3])
# A parabola whose slope at its places is the arc's: tiles stand upright on it.
X_M = 0.15 * np.tan(ARC_RAD)
ARC = array_at([(x, 0.0, -0.15 + x**2 / 0.3) for x in X_M.tolist()])
TURNING_ARC = ARC.model_copy(update={"servo": make_servo(zero_counts=0)})
FORCES_N = np.array([10.0, 20.0, 30.0, 40.0])
TILTED = 1.0 - np.cos(ARC_RAD)
EXACT = {"T01": Parameter(value=1.0, sigma=0.0)}


def estimate_mounted(
    gains: dict[str, Parameter],
    shear: tuple[float, float] | None = None,
    *,
    array: ArrayInfo = ARC,
    sigma_n: float = 0.0,
    counts: int = 0,
) -> Estimates:
    """Estimate four tiles of an arc under 10, 20, 30 and 40 N."""
    plan = newton_plan(array, sigma_n=sigma_n)
    parameter = None if shear is None else Parameter(value=shear[0], sigma=shear[1])
    mounted = MountCalibration(reference="plate", gains=gains, shear=parameter)
    calibration = plan.calibration.model_copy(update={"mounted": mounted})
    plan = make_plan(array, calibration, plan.tare, models=("static",))
    return estimate_load(FORCES_N.tolist(), plan, servo_counts=counts)


def test_a_gain_acts_on_its_tile_the_grf_and_the_centre() -> None:
    e = estimate_mounted({"T02": Parameter(value=1.5, sigma=0.0)})
    assert e.force_n[-1] == pytest.approx([10, 30, 30, 40])
    assert e.grf_n[-1] == pytest.approx(110)
    assert e.cop_x_m[-1] == pytest.approx(np.dot(X_M, [10, 30, 30, 40]) / 110)


def test_sigma_grows_with_a_gain_and_with_its_uncertainty() -> None:
    e = estimate_mounted({"T04": Parameter(value=2.0, sigma=0.1)}, (0.0, 0.0), sigma_n=0.5)
    assert e.force_sigma_n[-1] == pytest.approx([0.5, 0.5, 0.5, math.hypot(1.0, 0.1 * 40)])
    assert e.grf_sigma_n[-1] == pytest.approx(math.hypot(math.sqrt(3 * 0.25 + 1.0), 4.0))


@pytest.mark.parametrize("shear", [-1.0, 0.0, 0.7])
@pytest.mark.parametrize("counts", [0, 200, -300])
def test_the_vertical_force_of_a_tile_follows_its_angle(shear: float, counts: int) -> None:
    e = estimate_mounted(EXACT, (shear, 0.0), array=TURNING_ARC, counts=counts)
    angle_rad = counts * 2.0 * math.pi / 4096
    vertical_n = FORCES_N * (1.0 + shear * (1.0 - np.cos(ARC_RAD - angle_rad)))
    assert e.angle_rad[-1] == pytest.approx(angle_rad)
    assert e.grf_n[-1] == pytest.approx(vertical_n.sum())
    assert e.cop_x_m[-1] == pytest.approx((vertical_n * X_M).sum() / vertical_n.sum())
    assert e.force_n[-1] == pytest.approx(FORCES_N)


@pytest.mark.parametrize(
    ("array", "shear", "counts"),
    [(ARC, None, 0), (TURNING_ARC, (-1.0, 0.0), NO_SERVO_COUNTS)],
    ids=["unknown shear", "unknown angle"],
)
def test_an_unknown_shear_or_angle_makes_the_grf_uncertain_by_the_tilt(
    array: ArrayInfo, shear: tuple[float, float] | None, counts: int
) -> None:
    e = estimate_mounted(EXACT, shear, array=array, counts=counts)
    assert e.grf_n[-1] == pytest.approx(100)
    assert e.grf_sigma_n[-1] == pytest.approx(float(np.dot(FORCES_N, TILTED)))


def test_an_uncertain_shear_is_shared_by_all_tiles() -> None:
    e = estimate_mounted(EXACT, (-1.0, 0.2))
    assert e.grf_sigma_n[-1] == pytest.approx(0.2 * float(np.dot(FORCES_N, TILTED)))
    assert e.force_sigma_n[-1] == pytest.approx([0.0] * 4), "forces are along the tiles' axes"


@pytest.mark.parametrize("shear", [-1.0, -2.0])
def test_a_tile_nearly_parallel_to_the_ground_has_no_vertical_force(shear: float) -> None:
    e = estimate_mounted(EXACT, (shear, 0.1), array=TURNING_ARC, counts=1000)  # 88 degrees
    assert np.isnan([e.grf_n[-1], e.grf_sigma_n[-1], e.cop_x_m[-1]]).all()
    assert e.force_n[-1] == pytest.approx(FORCES_N)


@pytest.mark.parametrize(("tiles", "is_assumed"), [(4, False), (2, True)])
def test_a_plate_measures_the_assumed_scale_of_a_preset(tiles: int, is_assumed: bool) -> None:
    gains = {serial: Parameter(value=1.1, sigma=0.01) for serial in ARC.serials[:tiles]}
    mounted = MountCalibration(reference="plate", gains=gains)
    calibration = make_paper_shape_preset().model_copy(update={"mounted": mounted})
    plan = make_plan(ARC, calibration, newton_plan(ARC).tare, models=("static",))
    flags = estimate_load([5, 5, 5, 5], plan).estimate_flags
    is_flagged = bool(flags[-1] & EstimateFlag.ASSUMED_SCALE)
    assert (plan.is_scale_assumed, is_flagged) == (is_assumed, is_assumed)


def test_a_mount_calibration_is_part_of_the_id_and_the_file() -> None:
    mounted = MountCalibration(reference="plate", gains=EXACT)
    calibration = make_paper_shape_preset().model_copy(update={"mounted": mounted})
    assert calibration.id != make_paper_shape_preset().id
    assert Calibration.from_json_verifying_id(calibration.to_json(), where="here") == calibration


@pytest.mark.parametrize(
    ("gains", "shear", "match"),
    [
        ({"T01": 0.01}, None, "T01 has a gain of 0.01"),
        ({"T01": -1.0}, None, "T01 has a gain of -1"),
        ({}, None, "at least 1"),
        ({"T01": 1.0}, Parameter(value=-4.0, sigma=0.1), "shear of -4"),
    ],
)
def test_an_impossible_mount_is_refused(
    gains: dict[str, float], shear: Parameter | None, match: str
) -> None:
    parameters = {serial: Parameter(value=gain, sigma=0.1) for serial, gain in gains.items()}
    with pytest.raises(ValueError, match=match):
        MountCalibration(reference="plate", gains=parameters, shear=shear)
