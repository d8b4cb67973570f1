"""GRF and centre of pressure of one frame, from the forces on its tiles."""

from __future__ import annotations

import math

from devices.arrays import Floats
from devices.jit import jit_inlined
from service.estimation.pipeline.params import KernelParams
from service.estimation.pipeline.plan import SIGNIFICANCE_SIGMAS
from service.estimation.pipeline.smoothing_stage import (
    BOUND_SIGMAS,
    N_COMMON,
    TileForce,
    compute_weighted_sum_sigma,
)
from service.estimation.pipeline.state import TileSample
from service.estimation.records import RecordArray

VERTICAL_FRACTION_MIN = 0.1
"""Least vertical fraction; below it the shear of a plate, fitted to nearly upright tiles, is
meaningless."""
HULL_SIGMAS = 3.0  # noise about the edge of the tiles is no reason to mask
(
    GRF,
    GRF_SIGMA,
    GRF_LOWER_BOUND,
    COP_X,
    COP_Y,
    COP_SIGMA_X,
    COP_SIGMA_Y,
    COP_INDEX_X,
    COP_INDEX_Y,
    COP_GROUND_X,
    COP_GROUND_Y,
    FOOT_ANGLE,
    COP_Z,
) = range(13)
"""Columns of `compute_grf_cop`; the last is needed for the ground frame only."""
N_COLUMNS = 13
COLUMNS_BY_AXIS = ((COP_X, COP_SIGMA_X, COP_GROUND_X), (COP_Y, COP_SIGMA_Y, COP_GROUND_Y))
"""Columns of the centre of pressure along x, and along y."""


@jit_inlined
def set_plate_shear_fractions_and_sigma(
    params: KernelParams, forces: RecordArray[TileForce], angle_rad: float
) -> None:
    """Set the vertical fraction of each tile's force: 1, or by the shear of a force plate.

    With a force plate it is `1 + shear (1 - cos a)`, `a` between the tile's axis and the vertical;
    the remaining uncertainty is common to all tiles. It is 1 where the segment's angle is unknown,
    and 0 for a tile that hardly faces the ground.

    Args:
        params: of the estimate.
        forces: (tiles,), updated.
        angle_rad: of the segment.
    """
    foot_params, tiles = params.foot[0], params.tiles
    has_servo = foot_params.has_servo == 1
    is_known = foot_params.is_shear_known == 1 and not (has_servo and math.isnan(angle_rad))
    turned_rad = angle_rad if has_servo else 0.0
    for j in range(len(tiles)):
        force = forces[j]
        force.vertical_fraction = 1.0
        if is_known and tiles[j].is_load_bearing == 1:
            tilted = 1.0 - math.cos(tiles[j].axis_rad - turned_rad)
            force.vertical_fraction = 1.0 + foot_params.shear * tilted
            if force.vertical_fraction < VERTICAL_FRACTION_MIN:
                force.vertical_fraction = 0.0
                continue
            shear_n = foot_params.shear_sigma * tilted * force.force_n
            force.sigma_common_n[N_COMMON - 1] = shear_n / force.vertical_fraction


@jit_inlined
def compute_grf_cop(params: KernelParams, forces: RecordArray[TileForce], out: Floats) -> None:
    """Compute GRF, its sigma and lower bound, COP x, y, z, and sigmas of x and y, to first order.

    Where a tile is missing or saturated there is neither GRF nor COP, but a lower bound: saturated
    tiles count with their own lower bounds, missing ones with 0.

    Args:
        params: of the estimate.
        forces: (tiles,), with vertical fractions; their weights are overwritten.
        out: (`N_COLUMNS`,); its first seven columns and `COP_Z`, left as they are where undefined.
    """
    tiles = params.tiles
    total, known, measured = 0.0, 0, 0
    for j in range(len(tiles)):
        force = forces[j]
        force.weight = 0.0
        is_known = not math.isnan(force.force_n) and force.vertical_fraction > 0.0
        if tiles[j].is_load_bearing == 1 and is_known:
            total += force.vertical_fraction * force.force_n
            force.weight = force.vertical_fraction
            known += 1
            measured += 1 - force.is_saturated
    sigma_n = compute_weighted_sum_sigma(forces)
    if known > 0:
        out[GRF_LOWER_BOUND] = total - BOUND_SIGMAS * sigma_n
    if measured < params.foot[0].n_load_bearing:
        return
    out[GRF], out[GRF_SIGMA] = total, sigma_n
    if total == 0.0:
        return
    for axis, column in ((0, COP_X), (1, COP_Y), (2, COP_Z)):
        moment = 0.0
        for j in range(len(tiles)):
            if tiles[j].is_load_bearing == 1:
                vertical_n = forces[j].vertical_fraction * forces[j].force_n
                moment += vertical_n * tiles[j].position_m[axis]
        out[column] = moment / total
    for axis, column in ((0, COP_X), (1, COP_Y)):
        for j in range(len(tiles)):
            if tiles[j].is_load_bearing == 1:
                arm_m = tiles[j].position_m[axis] - out[column]
                forces[j].weight = forces[j].vertical_fraction * arm_m
        out[column + COP_SIGMA_X - COP_X] = compute_weighted_sum_sigma(forces) / abs(total)


@jit_inlined
def is_cop_unreliable(params: KernelParams, out: Floats) -> bool:
    """Return whether the COP is too uncertain, or farther outside the hull than noise explains."""
    foot_params = params.foot[0]
    x_m, y_m, sigma_x_m, sigma_y_m = out[COP_X], out[COP_Y], out[COP_SIGMA_X], out[COP_SIGMA_Y]
    good = (
        out[GRF] >= SIGNIFICANCE_SIGMAS * out[GRF_SIGMA]
        and sigma_x_m <= foot_params.cop_sigma_max_m
        and sigma_y_m <= foot_params.cop_sigma_max_m
    )
    for k in range(len(params.hull)):
        nx, ny, offset_m = params.hull[k]
        beyond_m = nx * x_m + ny * y_m - offset_m
        sigma_m = math.sqrt((nx * sigma_x_m) ** 2 + (ny * sigma_y_m) ** 2)
        # Noise about the edge passes, or the mean of the rest would lie inside.
        good = good and beyond_m <= HULL_SIGMAS * sigma_m + 1e-9
    return not good


@jit_inlined
def compute_gauge_weighted_cop_index(
    params: KernelParams, samples: RecordArray[TileSample], out: Floats
) -> None:
    """Compute the COP in grid indices from 1, weighted by gauge pressure (paper eq. 4)."""
    total_kpa = x = y = 0.0
    for j in range(len(params.tiles)):
        tile_params, gauge_kpa = params.tiles[j], samples[j].gauge_kpa
        if tile_params.is_load_bearing == 1:
            total_kpa += gauge_kpa
            x += gauge_kpa * tile_params.grid_index[0]
            y += gauge_kpa * tile_params.grid_index[1]
    if total_kpa != 0.0:
        out[COP_INDEX_X], out[COP_INDEX_Y] = x / total_kpa, y / total_kpa
