"""Ranges of an array's tiles, as the pages show them."""

from __future__ import annotations

import numpy as np
import pytest

from service.estimation.calibration import MountCalibration
from service.estimation.effects import Parameter
from service.server.estimates.live_estimator import TileRanges
from tests.builders.arrays import make_array, make_tile
from tests.builders.calibrations import make_calibration, newton_tile

ARRAY = make_array([make_tile(0), make_tile(1), make_tile(2, reference=True)])


@pytest.mark.parametrize(
    ("assumed", "mounted", "is_assumed"),
    [
        pytest.param((), (), False, id="none assumed"),
        pytest.param((0,), (), True, id="one assumed"),
        pytest.param((0, 1), (0,), True, id="one of two mounted"),
        pytest.param((0, 1), (0, 1), False, id="both mounted"),
        pytest.param((2,), (), False, id="a reference tile"),
    ],
)
def test_a_mount_gain_makes_an_assumed_scale_a_measured_one(
    assumed: tuple[int, ...], mounted: tuple[int, ...], is_assumed: bool
) -> None:
    serials = ARRAY.serials
    calibration = make_calibration(
        *[
            newton_tile(serial, absolute_scale="assumed" if i in assumed else "measured")
            for i, serial in enumerate(serials)
        ]
    )
    if mounted:
        gains = {serials[i]: Parameter(value=1.5, sigma=0.1) for i in mounted}
        calibration = calibration.model_copy(
            update={"mounted": MountCalibration(reference="plate", gains=gains)}
        )
    ranges = TileRanges.from_calibration(ARRAY, calibration)
    assert ranges.is_scale_assumed == is_assumed
    gain = [1.5 if i in mounted else 1.0 for i in range(2)]
    one_n = TileRanges.from_calibration(make_array(1), make_calibration("T01")).full_scale_n[0]
    np.testing.assert_allclose(ranges.full_scale_n, one_n * np.array([*gain, np.nan]))
