"""Geometry of the tiles: hull, grid, segment angle, transform from foot to ground frame.

Axes as in the design: foot frame x forward, y to the left, z up the segment, origin at the ankle.
A positive angle is a roll forward (right-handed about y).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from devices.arrays import Floats
from devices.frames import SAME_PLACE_M, ServoInfo
from devices.jit import jit_cached

_PARABOLA_POSITIONS_MIN = 3  # least positions along x that determine a parabola


class HalfPlanes(NamedTuple):
    """Half-planes `normals @ p <= offsets_m`, (k, 2) of unit length and (k,)."""

    normals: Floats
    offsets_m: Floats


def compute_hull_half_planes(positions_m: Floats) -> HalfPlanes:
    """Compute the half-planes whose intersection is the hull of (tiles, 2).

    Tiles in a line, or a single one, have a hull without area: two half-planes across every
    direction in which they do not extend would forbid any noise, so only the ends of the line
    count; across it a force-weighted mean cannot leave the line anyway.
    """
    centre_m = positions_m.mean(axis=0)
    _, spread_m, directions = np.linalg.svd(positions_m - centre_m)
    extends = np.zeros(2, dtype=bool)
    extends[: len(spread_m)] = spread_m > SAME_PLACE_M
    if extends.all():
        from scipy.spatial import ConvexHull

        equations = ConvexHull(positions_m).equations
        return HalfPlanes(equations[:, :2], -equations[:, 2])
    normals = np.concatenate([directions[extends], -directions[extends]])
    return HalfPlanes(normals, (positions_m @ normals.T).max(axis=0, initial=-np.inf))


def compute_grid_indices(
    positions_m: Floats,
) -> tuple[Floats, Floats] | None:
    """Return each tile's index along x and y, from 1 (paper eq. 4); None if they fill no grid.

    A line of tiles is a grid of one row.
    """
    columns, x = np.unique(np.round(positions_m[:, 0] / SAME_PLACE_M), return_inverse=True)
    rows, y = np.unique(np.round(positions_m[:, 1] / SAME_PLACE_M), return_inverse=True)
    places = set(zip(x.tolist(), y.tolist(), strict=True))
    if len(places) != len(positions_m) or len(places) != len(columns) * len(rows):
        return None
    return x.astype(np.float64) + 1.0, y.astype(np.float64) + 1.0


def fit_tile_axis_angles_rad(positions_m: Floats) -> Floats:
    """Fit the sole, and return the angle of each tile's axis to the segment, (tiles,).

    Tiles stand upright on their sole, whose shape along x is a parabola through their positions
    (tiles, 3). Zero if these do not determine it. As the segment rolls, tiles are vertical in turn.
    """
    x_m, z_m = positions_m[:, 0], positions_m[:, 2]
    if len(np.unique(np.round(x_m / SAME_PLACE_M))) < _PARABOLA_POSITIONS_MIN:
        return np.zeros(len(positions_m))
    design = np.stack([np.ones(len(x_m)), x_m, x_m**2], axis=1)
    (_, slope, bend), *_ = np.linalg.lstsq(design, z_m, rcond=None)
    return np.asarray(np.arctan(slope + 2.0 * bend * x_m))


def compute_tilt_loss(axis_rad: Floats) -> Floats:
    """Return the part of a force along each tile's axis that is not along the segment: 1 - cos."""
    return np.asarray(1.0 - np.cos(axis_rad))


def compute_segment_rad_per_count(servo: ServoInfo) -> float:
    """Return the segment's angle in rad for one count of the servo, signed."""
    return servo.sign * servo.ratio * 2.0 * math.pi / servo.counts_per_turn


@jit_cached
def transform_to_ground_x_m(
    x_m: float, z_m: float, angle_rad: float, ankle_travel_m_per_rad: float
) -> float:
    """Transform a point's x from foot to ground frame (paper eq. 3 with l = -z, r = -x).

    ankle travel + x cos(angle) + z sin(angle); NaN where the ankle's travel is.
    """
    turned_m = x_m * math.cos(angle_rad) + z_m * math.sin(angle_rad)
    return ankle_travel_m_per_rad * angle_rad + turned_m
