"""A row of tiles measures no centre of pressure across it: there it is NaN, and never the row."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.flags import EstimateFlag
from service.estimation.records import Estimates
from tests.builders.arrays import array_at, make_servo
from tests.builders.estimates import estimate, newton_plan
from tests.builders.frames import cut_up, loaded_frames
from tests.service.estimation.feet import SQUARE, held, wild_frames

ALONG = {
    "x": ("cop_x_m", "cop_sigma_x_m", "cop_ground_x_m"),
    "y": ("cop_y_m", "cop_sigma_y_m", "cop_ground_y_m"),
}
SINGLE = [SQUARE[3]]
ROW_IN_Y = [SQUARE[2], SQUARE[3]]
"""Along x, at y = 10 mm."""
ROW_IN_X = [SQUARE[1], SQUARE[3]]
"""Along y, at x = 20 mm."""


@pytest.mark.parametrize(
    ("positions_m", "measured"), [(SQUARE, "xy"), (ROW_IN_Y, "x"), (ROW_IN_X, "y"), (SINGLE, "")]
)
@pytest.mark.parametrize("degrees", [0, 20])
def test_only_what_the_tiles_measure_is_a_number(
    positions_m: list[tuple[float, float, float]], measured: str, degrees: int
) -> None:
    # A bare tile elsewhere bears nothing, and measures nothing.
    info = array_at([*positions_m, (0.3, 0.3, -0.15)], references=[len(positions_m)])
    info = info.model_copy(update={"servo": make_servo()})
    counts = [2048 + round(4096 * degrees / 360)] * 12
    loads_n = [30.0] * len(positions_m) + [0.0]
    e = estimate(newton_plan(info), loaded_frames(held(loads_n), servo_counts=counts))
    assert e.contact[-1] == 1
    assert e.estimate_flags[-1] == 0  # a frame in contact is not masked
    for axis, names in ALONG.items():
        for name in names:
            values = getattr(e, name)
            assert np.isfinite(values[-1]) == (axis in measured), name
            assert axis in measured or np.isnan(values).all(), name
    if "x" in measured:
        assert e.cop_sigma_x_m[-1] > 0.0
    if "y" in measured:
        assert e.cop_sigma_y_m[-1] > 0.0


def test_tiles_a_micrometre_apart_stand_in_one_row_and_two_apart_do_not() -> None:
    for apart_m, is_row in ((1e-6, True), (2e-6, False)):
        pair = array_at([(0.0, 0.0, -0.15), (0.02, apart_m, -0.15)])
        assert newton_plan(pair).cop_measured == (True, not is_row)


PLACES_M = st.sampled_from([-0.012, 0.0, 0.009, 0.02])


@settings(max_examples=25, deadline=None)
@given(
    places=st.lists(st.tuples(PLACES_M, PLACES_M), min_size=1, max_size=5),
    seed=st.integers(0, 2**32 - 1),
    lag_ms=st.sampled_from([0.0, 20.0]),
)
def test_whatever_the_layout_all_that_is_measured_keeps_its_bits(
    places: list[tuple[float, float]], seed: int, lag_ms: float
) -> None:
    info = array_at([(x_m, y_m, -0.15) for x_m, y_m in places], servo=make_servo())
    plan = newton_plan(info, lag_ms=lag_ms)
    frames = wild_frames(120, len(places), seed)
    found = estimate(plan, *cut_up(frames, [7, 40]))
    # As before the row was known: its place, with a sigma of 0.
    with_row = estimate(replace(plan, cop_measured=(True, True)), frames)
    unmeasured = {
        name
        for axis, k in (("x", 0), ("y", 1))
        if len({place[k] for place in places}) == 1
        for name in ALONG[axis]
    }
    for field in fields(Estimates):
        values = getattr(found, field.name)
        if field.name in unmeasured:
            assert np.isnan(values).all(), field.name
        else:
            assert values.tobytes() == getattr(with_row, field.name).tobytes(), field.name
    masked = (found.estimate_flags & EstimateFlag.COP_MASKED) != 0
    for axis, names in ALONG.items():
        if names[0] not in unmeasured:
            assert (np.isnan(getattr(found, f"cop_{axis}_m")) == masked).all()
