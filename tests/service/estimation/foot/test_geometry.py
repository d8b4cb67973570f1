"""Hull, grid, segment angle and the ground frame."""

from __future__ import annotations

import math
from random import Random
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from devices.frames import ServoInfo
from service.estimation.foot import (
    compute_grid_indices_from_1,
    compute_hull_half_planes,
    compute_segment_rad_per_count,
    compute_tilt_loss,
    fit_tile_axis_angles_rad,
    transform_to_ground_x_m,
)
from tests.builders.arrays import make_servo

COORDINATES_M = st.integers(-100, 100).map(lambda mm: mm / 1000)
LINE = (-0.021, -0.007, 0.007, 0.021)


# --- hull -----------------------------------------------------------------------------------------


def compute_outside_m(positions: Any, point: Any) -> float:
    """Compute the distance of a point outside the hull; zero or less inside."""
    normals, offsets_m = compute_hull_half_planes(np.array(positions))
    assert normals.shape == (len(offsets_m), 2)
    np.testing.assert_allclose(np.hypot(*normals.T), 1.0, atol=1e-12)
    return float((normals @ np.array(point) - offsets_m).max(initial=-np.inf))


@settings(deadline=None)  # the first call loads scipy
@given(
    st.dictionaries(
        st.tuples(COORDINATES_M, COORDINATES_M), st.floats(0, 30), min_size=1, max_size=8
    )
)
def test_a_weighted_mean_of_tiles_is_inside_their_hull(
    weights: dict[tuple[float, float], float],
) -> None:
    assume(sum(weights.values()) > 0.1)
    mean = np.average(list(weights), axis=0, weights=list(weights.values()))
    assert compute_outside_m(list(weights), mean) < 1e-9


SQUARE = [(0.0, 0.0), (0.1, 0.0), (0.0, 0.1), (0.1, 0.1), (0.05, 0.05)]


@pytest.mark.parametrize(
    ("positions", "point", "outside_m"),
    [
        (SQUARE, (0.05, 0.05), -0.05),
        (SQUARE, (0.12, 0.05), 0.02),
        (SQUARE, (0.05, -0.01), 0.01),
        (SQUARE[:3], (0.1, 0.1), 0.1 / math.sqrt(2)),
        (SQUARE[:1], (5.0, 5.0), -math.inf),
    ],
)
def test_the_distance_from_a_hull_is_as_worked_out_by_hand(
    positions: list[tuple[float, float]], point: tuple[float, float], outside_m: float
) -> None:
    assert compute_outside_m(positions, point) == pytest.approx(outside_m)


@pytest.mark.parametrize("turned", [0.0, 0.3, math.pi / 2, 2.5])
def test_a_line_of_tiles_is_bounded_by_its_ends(turned: float) -> None:
    along = np.array([math.cos(turned), math.sin(turned)])
    line = np.multiply.outer(LINE, along)
    found = [compute_outside_m(line, s * along) for s in (0.020, 0.022, -0.022)]
    assert found == pytest.approx([-0.001, 0.001, 0.001])


def test_tiles_less_than_a_micrometre_out_of_line_are_in_line() -> None:
    crooked = [(0.0, 0.0), (0.01, 4e-7), (0.02, -4e-7)]
    assert len(compute_hull_half_planes(np.array(crooked)).normals) == 2


# --- grid -----------------------------------------------------------------------------------------


@given(st.integers(1, 4), st.integers(1, 4), st.randoms(use_true_random=False))
def test_grid_indices_count_from_one_in_any_order_of_tiles(
    columns: int, rows: int, random: Random
) -> None:
    places = [(i, j) for i in range(1, columns + 1) for j in range(1, rows + 1)]
    random.shuffle(places)
    grid = compute_grid_indices_from_1(np.array([(0.013 * i - 0.1, 0.02 * j) for i, j in places]))
    assert grid is not None
    assert list(zip(*(axis.tolist() for axis in grid), strict=True)) == places


@pytest.mark.parametrize(
    "positions",
    [
        [(0.0, 0.0), (0.01, 0.0), (0.0, 0.01)],  # a corner is missing
        [(0.0, 0.0), (0.0, 0.0)],  # two in one place
        [(0.0, 0.0), (0.01, 0.002), (0.02, 0.0), (0.03, 0.002)],  # zigzag
    ],
)
def test_tiles_that_fill_no_grid_have_no_indices(positions: list[tuple[float, float]]) -> None:
    assert compute_grid_indices_from_1(np.array(positions)) is None


# --- angle ----------------------------------------------------------------------------------------


def compute_angle_rad(info: ServoInfo, counts: float) -> float:
    return (counts - info.zero_counts) * compute_segment_rad_per_count(info)


@pytest.mark.parametrize(
    ("counts", "expected_rad"),
    [
        (2048, 0.0),
        (2048 + 1024, math.pi / 2),
        (2048 - 1024, -math.pi / 2),
        (4095, 2 * math.pi * 2047 / 4096),
        (4096, math.pi),  # one count after 4095: no jump at the end of a turn
        (2048 + 3 * 4096, 6 * math.pi),
        (2048 - 5 * 4096 - 1, -10 * math.pi - 2 * math.pi / 4096),
        (-1, -2 * math.pi * 2049 / 4096),
        (2**31 - 1, 2 * math.pi * (2**31 - 1 - 2048) / 4096),
        (-(2**31) + 1, 2 * math.pi * (-(2**31) + 1 - 2048) / 4096),
    ],
)
def test_counts_become_an_angle_over_any_number_of_turns(counts: int, expected_rad: float) -> None:
    assert compute_angle_rad(make_servo(), counts) == pytest.approx(
        expected_rad, rel=1e-15, abs=1e-15
    )


def test_an_angle_has_the_scenes_sign_ratio_and_zero() -> None:
    servo = make_servo(zero_counts=0, sign=-1, ratio=0.1)
    assert compute_angle_rad(servo, 4096) == pytest.approx(-0.2 * math.pi)


# --- ground frame ---------------------------------------------------------------------------------


@given(st.floats(-math.pi / 2, math.pi / 2))
def test_a_touching_tile_of_a_rolling_arc_is_under_the_ankle(arc_rad: float) -> None:
    # The ankle of a wheel of 150 mm has come 150 mm a radian.
    x_m, z_m = 0.150 * math.sin(arc_rad), -0.150 * math.cos(arc_rad)
    assert transform_to_ground_x_m(x_m, z_m, arc_rad, 0.150) == pytest.approx(
        0.150 * arc_rad, abs=1e-15
    )


@given(st.floats(-math.pi / 2, math.pi / 2), st.floats(-0.1, 0.1), st.floats(-0.3, 0.0))
def test_the_ground_frame_is_the_papers_equation_3(angle: float, x_m: float, z_m: float) -> None:
    # eq. 3, its y our x: the segment of length l leans by the angle, r stands off perpendicular to
    # it; l = -z, r = -x
    length, offset = -z_m, -x_m
    expected = -length * math.sin(angle) - offset * math.cos(angle)
    assert transform_to_ground_x_m(x_m, z_m, angle, 0.0) == pytest.approx(expected, abs=1e-15)


@pytest.mark.parametrize(
    ("x_m", "angle_rad", "travel_m_per_rad", "ground_x_m"),
    [
        (0.02, math.pi / 2, 0.0, -0.15),
        (0.02, -math.pi / 2, 0.0, 0.15),
        (0.02, 0.1, math.nan, math.nan),
        (0.02, math.nan, 0.15, math.nan),
        (math.nan, 0.1, 0.15, math.nan),
    ],
)
def test_a_ground_position_is_as_worked_out_by_hand(
    x_m: float, angle_rad: float, travel_m_per_rad: float, ground_x_m: float
) -> None:
    found_m = transform_to_ground_x_m(x_m, -0.15, angle_rad, travel_m_per_rad)
    assert found_m == pytest.approx(ground_x_m, nan_ok=True)


def test_tiles_push_along_the_radii_of_an_arc_and_upright_on_a_plane() -> None:
    arc_rad = np.array([-0.14, -0.047, 0.047, 0.14])
    arc_m = 0.15 * np.stack([np.sin(arc_rad), 0 * arc_rad, -np.cos(arc_rad)], axis=1)
    assert compute_tilt_loss(fit_tile_axis_angles_rad(arc_m)) == pytest.approx(
        1.0 - np.cos(arc_rad), rel=0.05, abs=1e-5
    )
    flat_m = arc_m * [1.0, 1.0, 0.0] - [0.0, 0.0, 0.15]
    assert compute_tilt_loss(fit_tile_axis_angles_rad(flat_m)) == pytest.approx(
        np.zeros(4), abs=1e-12
    )


@pytest.mark.parametrize("x_m", [[0.0], [0.0, 0.02], [0.0, 0.0, 0.02, 0.02]])
def test_too_few_places_show_no_curvature(x_m: list[float]) -> None:
    positions_m = np.array([[x, 0.01 * i, -0.15 + x] for i, x in enumerate(x_m)])
    assert (fit_tile_axis_angles_rad(positions_m) == 0.0).all()
