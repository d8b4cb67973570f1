"""Shares of a recorded load among tiles, against an exhaustive search and by hand."""

from __future__ import annotations

from itertools import combinations
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from devices.emulation.ground.load_trace import (
    FORCE_LIMIT_N,
    TOUCH_S,
    CopTransform,
    LoadTrace,
    TileLoad,
    convert_to_tile_load,
)
from devices.errors import LoadTraceError, UsageError

Floats = npt.NDArray[np.float64]

LINE = np.array([(-0.021, 0.0), (-0.007, 0.0), (0.007, 0.0), (0.021, 0.0)])
SQUARE = np.array([(-0.05, -0.03), (-0.05, 0.03), (0.05, -0.03), (0.05, 0.03)])
NAN = float("nan")


def trace_of(
    fz_n: list[float] | Floats | None = None,
    cop_m: list[tuple[float, float]] | Floats | None = None,
    cells_n: list[list[float]] | None = None,
    **changes: Any,
) -> LoadTrace:
    n = len(fz_n if fz_n is not None else cells_n or [])
    facts: dict[str, Any] = {
        "where": "walk.csv",
        "time_s": 0.01 * np.arange(n),
        "cells_n": None if cells_n is None else np.array(cells_n),
        "fz_n": None if fz_n is None else np.array(fz_n, dtype=np.float64),
        "cop_m": None if cop_m is None else np.array(cop_m, dtype=np.float64),
        "angle_rad": None,
    }
    return LoadTrace(**(facts | changes))


def pressed(
    trace: LoadTrace,
    positions_m: Floats = SQUARE,
    *,
    bears: list[bool] | None = None,
    load_scale: float = 1.0,
    lead_s: float = 1.0,
    **cop: Any,
) -> TileLoad:
    return convert_to_tile_load(
        trace,
        positions_m,
        np.array([True] * len(positions_m) if bears is None else bears),
        load_scale=load_scale,
        cop_transform=CopTransform(**cop),
        lead_s=lead_s,
    )


def shares(cop_m: tuple[float, float], positions_m: Floats) -> tuple[Floats, int]:
    """Return shares of one newton with its COP at a place, and the number of moved COPs."""
    # One sample is its own mean, so the place is given as the offset.
    one = pressed(trace_of([1.0], [(0.0, 0.0)]), positions_m, offset_m=cop_m)
    return one.forces_n[1], one.moved_samples


def exhaustive(cop_m: Floats, positions_m: Floats) -> Floats | None:
    """Return the least sum of squares of all sets of tiles."""
    best: Floats | None = None
    n = len(positions_m)
    wanted = np.append(1.0, cop_m)
    for size in range(1, n + 1):
        for chosen in combinations(range(n), size):
            rows = np.vstack([np.ones(size), positions_m[list(chosen)].T])
            force = np.linalg.pinv(rows) @ wanted
            if np.abs(rows @ force - wanted).max() > 1e-9 or force.min() < -1e-12:
                continue
            whole = np.zeros(n)
            whole[list(chosen)] = force
            if best is None or whole @ whole < best @ best:
                best = whole
    return best


# Sharing


places = st.tuples(st.integers(-20, 20), st.integers(-20, 20)).map(
    lambda p: (p[0] * 0.005, p[1] * 0.005)
)


@settings(max_examples=60, deadline=None)
@given(
    positions=st.lists(places, min_size=3, max_size=6, unique=True),
    weights=st.lists(st.floats(0, 1), min_size=6, max_size=6),
)
def test_sum_and_moment_are_exact_and_the_sum_of_squares_is_the_least(
    positions: list[tuple[float, float]], weights: list[float]
) -> None:
    positions_m = np.array(positions)
    spread = np.linalg.svd(positions_m - positions_m.mean(0), compute_uv=False)
    assume(spread[1] > 0.01)  # a line across the axes is another matter
    weight = np.array(weights[: len(positions)]) + 1e-3
    cop_m = weight @ positions_m / weight.sum()
    force, moved = shares((float(cop_m[0]), float(cop_m[1])), positions_m)
    assert moved == 0
    assert (force >= 0).all()
    assert force.sum() == pytest.approx(1.0, abs=1e-6)
    np.testing.assert_allclose(force @ positions_m, cop_m, atol=1e-6)
    best = exhaustive(cop_m, positions_m)
    assert best is not None
    np.testing.assert_allclose(force, best, atol=1e-4)
    assert force @ force <= best @ best + 1e-6


def nearest_on_hull(cop_m: Floats, positions_m: Floats) -> Floats:
    """Return the nearest point of all segments between two tiles."""
    candidates = []
    for a, b in combinations(positions_m, 2):
        along = np.clip((cop_m - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
        candidates.append(a + along * (b - a))
    return min(candidates, key=lambda point: float(np.linalg.norm(point - cop_m)))


@settings(max_examples=60, deadline=None)
@given(angle=st.floats(0, 2 * np.pi), far_m=st.floats(0.08, 1.0))
def test_a_cop_outside_the_tiles_is_moved_to_the_nearest_edge_and_counted(
    angle: float, far_m: float
) -> None:
    cop_m = far_m * np.array([np.cos(angle), np.sin(angle)])
    force, moved = shares((float(cop_m[0]), float(cop_m[1])), SQUARE)
    assert moved == 1
    assert (force >= 0).all()
    assert force.sum() == pytest.approx(1.0, abs=1e-6)
    np.testing.assert_allclose(force @ SQUARE, nearest_on_hull(cop_m, SQUARE), atol=1e-5)


@pytest.mark.parametrize("tile", range(4))
def test_a_cop_on_a_corner_loads_the_tile_there_and_is_not_counted(tile: int) -> None:
    force, moved = shares((float(SQUARE[tile, 0]), float(SQUARE[tile, 1])), SQUARE)
    np.testing.assert_allclose(force, np.eye(4)[tile], atol=1e-5)
    assert moved == 0


def test_each_moved_sample_is_counted_once_and_unloaded_ones_are_not() -> None:
    cop = [(0.0, 0.0), (0.2, 0.0), (0.0, 0.0), (-0.2, 0.0), (0.9, 0.0)]
    result = pressed(trace_of([10.0, 10.0, 10.0, 10.0, 0.0], cop))
    assert result.moved_samples == 2


@pytest.mark.parametrize("beside_m", [0.0, 0.03])
def test_a_line_of_tiles_ignores_the_cop_across_it(beside_m: float) -> None:
    line = LINE + np.array([0.0, beside_m])
    straight = pressed(trace_of([10, 10], [(-0.01, 0.0), (0.01, 0.0)]), line)
    aslant = pressed(trace_of([10, 10], [(-0.01, -0.4), (0.01, 0.4)]), line)
    np.testing.assert_allclose(aslant.forces_n, straight.forces_n, atol=1e-9)
    assert aslant.moved_samples == straight.moved_samples == 0
    np.testing.assert_allclose(straight.forces_n[1:-1] @ line[:, 0] / 10, [-0.01, 0.01], atol=1e-6)


def test_a_single_tile_bears_everything() -> None:
    result = pressed(trace_of([7.0, 9.0], [(0.0, 0.3), (0.1, -0.2)]), np.array([(0.02, 0.01)]))
    np.testing.assert_allclose(result.forces_n[1:-1, 0], [7.0, 9.0], atol=1e-6)
    assert result.moved_samples == 0


def test_a_reference_tile_bears_nothing_and_is_no_cell() -> None:
    bears = [True, False, True, True, True]
    positions = np.insert(SQUARE, 1, (0.0, 0.0), axis=0)
    result = pressed(trace_of([8.0], [(0, 0)]), positions, bears=bears)
    np.testing.assert_allclose(result.forces_n[1], [2, 0, 2, 2, 2], atol=1e-6)
    cells = pressed(trace_of(cells_n=[[1.0, 2.0, 3.0, 4.0]]), positions, bears=bears)
    np.testing.assert_allclose(cells.forces_n[1], [1, 0, 2, 3, 4])


# The centre of pressure


def test_a_cop_is_scaled_about_its_force_weighted_mean_and_then_moved() -> None:
    fz = np.array([10.0, 30.0, 20.0])
    cop = np.array([(0.30, 0.10), (0.32, 0.10), (0.28, 0.13)])
    centre = fz @ cop / fz.sum()
    result = pressed(trace_of(fz, cop), scale=0.5, offset_m=(0.01, -0.005))
    reached = result.forces_n[1:-1] @ SQUARE / fz[:, None]
    np.testing.assert_allclose(reached, 0.5 * (cop - centre) + [0.01, -0.005], atol=1e-6)


@pytest.mark.parametrize(
    ("axes", "x", "y"),
    [
        ("xy", (1, 0), (0, 1)),
        ("+x+y", (1, 0), (0, 1)),
        ("yx", (0, 1), (1, 0)),
        ("-yx", (0, -1), (1, 0)),
        ("y-x", (0, 1), (-1, 0)),
        ("-x-y", (-1, 0), (0, -1)),
    ],
)
def test_axes_of_the_trace_become_axes_of_the_foot(
    axes: str, x: tuple[int, int], y: tuple[int, int]
) -> None:
    matrix = CopTransform(axes=axes).make_axes_matrix()
    np.testing.assert_array_equal(matrix, [x, y])
    cop = np.array([(-0.01, -0.02), (0.01, 0.02)])
    result = pressed(trace_of([10, 10], cop), axes=axes)
    reached = result.forces_n[1:-1] @ SQUARE / 10
    np.testing.assert_allclose(reached[:, 0], cop @ x, atol=1e-6)
    np.testing.assert_allclose(reached[:, 1], cop @ y, atol=1e-6)


@pytest.mark.parametrize("axes", ["", "x", "xx", "yy", "-x-x", "xz", "xyz", "x y", "--xy", "XY"])
def test_a_text_of_no_two_axes_is_refused(axes: str) -> None:
    with pytest.raises(UsageError) as caught:
        pressed(trace_of([1.0], [(0, 0)]), axes=axes)
    assert repr(axes) in str(caught.value)
    assert "-yx" in caught.value.expected
    assert caught.value.exit_code == 2


def test_a_cop_may_be_missing_where_there_is_hardly_any_load() -> None:
    fz = [0.0, 0.9, 100.0, 100.0, -0.9]
    cop = [(NAN, NAN), (NAN, NAN), (-0.01, 0.0), (0.01, 0.0), (NAN, 0.0)]
    result = pressed(trace_of(fz, cop), load_scale=0.1)
    np.testing.assert_allclose(result.forces_n[1:-1].sum(axis=1), [0, 0.09, 10, 10, 0], atol=1e-6)
    assert result.moved_samples == 0


@pytest.mark.parametrize("missing", [(NAN, NAN), (NAN, 0.0), (0.0, NAN)])
@pytest.mark.parametrize("fz_n", [1.1, -1.1, 50.0])
def test_a_cop_that_is_missing_under_load_is_refused_with_its_row(
    missing: tuple[float, float], fz_n: float
) -> None:
    trace = trace_of([100.0, fz_n], [(0.0, 0.0), missing])
    with pytest.raises(LoadTraceError) as caught:
        pressed(trace)
    assert caught.value.where == "walk.csv"
    assert "row 2" in str(caught.value)
    assert f"{fz_n:g} N" in str(caught.value)


def test_a_missing_cop_does_not_shift_the_mean() -> None:
    cop = [(0.31, 0.0), (NAN, NAN), (0.29, 0.0)]
    result = pressed(trace_of([100.0, 0.9, 100.0], cop), load_scale=0.1)
    assert (result.forces_n[1] @ SQUARE / 10)[0] == pytest.approx(0.01, abs=1e-6)


def test_a_trace_that_never_loads_the_foot_is_refused_and_a_pull_bears_nothing() -> None:
    for fz in ([0.0, 0.0], [-5.0, -1.0]):
        with pytest.raises(LoadTraceError, match=r"walk\.csv: the trace never loads"):
            pressed(trace_of(fz, [(0.0, 0.0)] * 2))
    result = pressed(trace_of([10.0, -3.0], [(0.0, 0.0)] * 2))
    np.testing.assert_allclose(result.forces_n[2], 0.0)


def test_a_trace_without_a_load_column_is_refused() -> None:
    with pytest.raises(LoadTraceError) as caught:
        pressed(trace_of([1.0]))
    assert "cop_x_m and cop_y_m" in caught.value.expected


# Cells


def test_cells_replace_the_total_force() -> None:
    cells = [[1.0, 2.0, 3.0, 4.0], [4.0, 3.0, 2.0, 0.0]]
    result = pressed(trace_of([99.0, 99.0], [(0, 0)] * 2, cells), load_scale=2.0)
    np.testing.assert_allclose(result.forces_n[1:-1], 2 * np.array(cells))
    assert result.moved_samples == 0


@pytest.mark.parametrize(("n", "bearing"), [(1, 4), (3, 4), (5, 4), (4, 3)])
def test_another_number_of_cells_than_tiles_is_refused_with_both(n: int, bearing: int) -> None:
    with pytest.raises(LoadTraceError, match=f"{n} cell columns.* {bearing} tiles") as caught:
        pressed(trace_of(cells_n=[[1.0] * n]), bears=[i < bearing for i in range(4)])
    assert caught.value.where == "walk.csv"


# Limits and time


def test_the_force_on_a_tile_is_limited_and_counted_by_sample() -> None:
    cells = [[10.0, 121.0, 180.0, 0.0], [120.0, 120.0, 120.0, 120.0], [0.0, 0.0, 0.0, 120.1]]
    result = pressed(trace_of(cells_n=cells))
    assert FORCE_LIMIT_N == 120.0  # four times 30 N, the middle of paper III-A's range
    assert result.limited_samples == 2
    np.testing.assert_allclose(
        result.forces_n[1:-1], [[10, 120, 120, 0], [120] * 4, [0, 0, 0, 120]], atol=1e-9
    )


def test_a_load_is_scaled_before_it_is_limited() -> None:
    assert pressed(trace_of(cells_n=[[800.0] * 4]), load_scale=0.05).limited_samples == 0
    assert pressed(trace_of([20_000.0], [(0, 0)]), load_scale=0.05).limited_samples == 1
    assert pressed(trace_of([4_000.0], [(0, 0)]), load_scale=0.05).limited_samples == 0


@pytest.mark.parametrize("lead_s", [0.0, 1.0, 2.5])
def test_a_trace_begins_after_the_lead_and_ends_unloaded(lead_s: float) -> None:
    trace = trace_of(cells_n=[[5.0] * 4, [6.0] * 4], time_s=np.array([100.0, 100.5]))
    result = pressed(trace, lead_s=lead_s)
    np.testing.assert_allclose(
        result.time_s,
        [lead_s, lead_s + TOUCH_S, lead_s + TOUCH_S + 0.5, lead_s + 2 * TOUCH_S + 0.5],
    )
    np.testing.assert_allclose(result.forces_n[:, 0], [0, 5, 6, 0])


def test_the_angle_is_that_of_the_trace_and_constant_beyond_its_ends() -> None:
    trace = trace_of(cells_n=[[1.0] * 4] * 2, angle_rad=np.array([-0.1, 0.2]))
    angle_rad = pressed(trace).angle_rad
    assert angle_rad is not None
    np.testing.assert_allclose(angle_rad, [-0.1, -0.1, 0.2, 0.2])
    assert pressed(trace_of(cells_n=[[1.0] * 4])).angle_rad is None
