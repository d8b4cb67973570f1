"""Hull, grid, segment angle and the ground frame."""

from __future__ import annotations

import math
from random import Random

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from devices.frames import ServoInfo
from service.estimation.foot.geometry import (
    compute_grid_indices_from_1,
    compute_hull_half_planes,
    compute_segment_rad_per_count,
    compute_tilt_loss,
    fit_tile_axis_angles_rad,
    transform_to_ground_x_m,
)
from tests.builders.arrays import make_servo

coordinates = st.integers(-100, 100).map(lambda mm: mm / 1000)
points = st.lists(st.tuples(coordinates, coordinates), min_size=1, max_size=8, unique=True)


def beyond_m(positions: list[tuple[float, float]], point: tuple[float, float]) -> float:
    """How far a point lies outside the hull; zero or less inside."""
    normals, offsets_m = compute_hull_half_planes(np.array(positions))
    assert normals.shape == (len(offsets_m), 2)
    np.testing.assert_allclose(np.hypot(*normals.T), 1.0, atol=1e-12)
    return float((normals @ np.array(point) - offsets_m).max(initial=-np.inf))


def angle_at(info: ServoInfo, counts: float) -> float:
    return (counts - info.zero_counts) * compute_segment_rad_per_count(info)


# --- hull -----------------------------------------------------------------------------------------


@settings(deadline=None)  # the first call loads scipy
@given(points, st.data())
def test_no_weighted_mean_of_the_tiles_lies_outside_their_hull(
    positions: list[tuple[float, float]], data: st.DataObject
) -> None:
    weights = np.array(
        data.draw(st.lists(st.floats(0, 30), min_size=len(positions), max_size=len(positions)))
    )
    assume(weights.sum() > 0.1)
    mean = weights @ np.array(positions) / weights.sum()
    assert beyond_m(positions, (float(mean[0]), float(mean[1]))) < 1e-9


def test_the_hull_of_a_square_is_its_sides() -> None:
    square = [(0.0, 0.0), (0.1, 0.0), (0.0, 0.1), (0.1, 0.1), (0.05, 0.05)]
    assert beyond_m(square, (0.05, 0.05)) == pytest.approx(-0.05)
    assert beyond_m(square, (0.12, 0.05)) == pytest.approx(0.02)
    assert beyond_m(square, (0.05, -0.01)) == pytest.approx(0.01)


def test_the_hull_of_a_triangle_is_not_its_bounding_box() -> None:
    triangle = [(0.0, 0.0), (0.1, 0.0), (0.0, 0.1)]
    assert beyond_m(triangle, (0.1, 0.1)) == pytest.approx(0.1 / math.sqrt(2))


@pytest.mark.parametrize("turned", [0.0, 0.3, math.pi / 2, 2.5])
def test_only_the_ends_of_a_line_of_tiles_bound_it(turned: float) -> None:
    along = np.array([math.cos(turned), math.sin(turned)])
    line = [tuple((along * s).tolist()) for s in (-0.021, -0.007, 0.007, 0.021)]
    assert beyond_m(line, tuple((0.020 * along).tolist())) == pytest.approx(-0.001)
    assert beyond_m(line, tuple((0.022 * along).tolist())) == pytest.approx(0.001)
    assert beyond_m(line, tuple((-0.022 * along).tolist())) == pytest.approx(0.001)


def test_a_single_tile_has_no_edge_to_be_beyond() -> None:
    assert beyond_m([(0.01, 0.02)], (5.0, 5.0)) == -np.inf


def test_tiles_a_micrometre_out_of_line_are_in_line() -> None:
    crooked = [(0.0, 0.0), (0.01, 4e-7), (0.02, -4e-7)]
    assert len(compute_hull_half_planes(np.array(crooked)).normals) == 2


# --- grid -----------------------------------------------------------------------------------------


def test_grid_indices_count_from_one_along_each_axis() -> None:
    positions = np.array([(0.0, 0.0), (0.01, 0.0), (0.0, 0.02), (0.01, 0.02)])
    grid = compute_grid_indices_from_1(positions)
    assert grid is not None
    assert grid[0].tolist() == [1.0, 2.0, 1.0, 2.0]
    assert grid[1].tolist() == [1.0, 1.0, 2.0, 2.0]


@given(st.integers(1, 4), st.integers(1, 4), st.randoms(use_true_random=False))
def test_tiles_of_a_grid_have_their_indices_in_whatever_order_they_are_listed(
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


@pytest.mark.parametrize(
    ("counts", "expected_rad"),
    [
        (2048, 0.0),
        (2048 + 1024, math.pi / 2),
        (2048 - 1024, -math.pi / 2),
        (4095, 2 * math.pi * 2047 / 4096),
        (4096, math.pi),  # one count after 4095: an angle does not jump where a turn ends
        (2048 + 3 * 4096, 6 * math.pi),
        (2048 - 5 * 4096 - 1, -10 * math.pi - 2 * math.pi / 4096),
        (-1, -2 * math.pi * 2049 / 4096),
        (2**31 - 1, 2 * math.pi * (2**31 - 1 - 2048) / 4096),
        (-(2**31) + 1, 2 * math.pi * (-(2**31) + 1 - 2048) / 4096),
    ],
)
def test_counts_become_an_angle_over_any_number_of_turns(counts: int, expected_rad: float) -> None:
    assert angle_at(make_servo(), counts) == pytest.approx(expected_rad, rel=1e-15, abs=1e-15)


def test_sign_ratio_and_zero_are_the_scenes() -> None:
    assert angle_at(make_servo(zero_counts=0, sign=-1, ratio=0.1), 4096) == pytest.approx(
        -0.2 * math.pi
    )


def test_unknown_counts_have_no_angle() -> None:
    assert math.isnan(angle_at(make_servo(), math.nan))


# --- ground frame ---------------------------------------------------------------------------------


def ground_x_m(x_m: float, z_m: float, angle: float, travel: float | None) -> float:
    return float(transform_to_ground_x_m(x_m, z_m, angle, math.nan if travel is None else travel))


@given(st.floats(-math.pi / 2, math.pi / 2))
def test_a_tile_of_a_rolling_arc_lies_under_the_ankle_when_it_touches(arc_rad: float) -> None:
    # The ankle of a wheel of 150 mm has come 150 mm a radian, and what touches is under it.
    x_m, z_m = 0.150 * math.sin(arc_rad), -0.150 * math.cos(arc_rad)
    assert ground_x_m(x_m, z_m, arc_rad, 0.150) == pytest.approx(0.150 * arc_rad, abs=1e-15)


@given(st.floats(-math.pi / 2, math.pi / 2), st.floats(-0.1, 0.1), st.floats(-0.3, 0.0))
def test_the_ground_frame_is_the_papers_equation_3(angle: float, x_m: float, z_m: float) -> None:
    # eq. 3, its y our x: the segment of length l leans by the angle, r stands off perpendicular to
    # it; l = -z, r = -x
    length, offset = -z_m, -x_m
    expected = -length * math.sin(angle) - offset * math.cos(angle)
    assert ground_x_m(x_m, z_m, angle, 0.0) == pytest.approx(expected, abs=1e-15)


def test_at_a_right_angle_the_segment_lies_along_the_ground() -> None:
    assert ground_x_m(0.02, -0.15, math.pi / 2, 0.0) == pytest.approx(-0.15)
    assert ground_x_m(0.02, -0.15, -math.pi / 2, 0.0) == pytest.approx(0.15)


def test_where_the_ankle_goes_unknown_the_ground_frame_is_unknown() -> None:
    assert math.isnan(ground_x_m(0.02, -0.15, 0.1, None))
    assert math.isnan(ground_x_m(0.02, -0.15, math.nan, 0.15))
    assert math.isnan(ground_x_m(math.nan, -0.15, 0.1, 0.15))


def test_tiles_on_an_arc_push_along_its_radii_and_on_a_plane_along_the_segment() -> None:
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
def test_too_few_places_do_not_show_how_a_sole_is_curved(x_m: list[float]) -> None:
    positions_m = np.array([[x, 0.01 * i, -0.15 + x] for i, x in enumerate(x_m)])
    assert (fit_tile_axis_angles_rad(positions_m) == 0.0).all()
