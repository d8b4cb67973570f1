"""The foot as a whole: GRF and centre of pressure of one frame, from what its tiles bear."""

from __future__ import annotations

import math

from devices.arrays import Floats
from devices.compiled import inlined
from service.estimation.ladder.laws import Laws
from service.estimation.ladder.plan import SIGMAS
from service.estimation.ladder.upper import BOUND_SIGMAS, PARTS, sigma_of_sum
from service.estimation.records import Records

UPRIGHT_LEAST = 0.1  # below it what a plate has told of tiles nearly upright says nothing
HULL_SIGMAS = 3.0  # noise about the edge of the tiles is no reason to mask
GRF, GRF_SIGMA, AT_LEAST, X, Y, SIGMA_X, SIGMA_Y, INDEX_X, INDEX_Y, GROUND_X, GROUND_Y, ANGLE, Z = (
    range(13)
)
"""Places of the answers in a row of `stand`; the last is needed for the ground only."""
COLUMNS = 13
ALONG = ((X, SIGMA_X, GROUND_X), (Y, SIGMA_Y, GROUND_Y))
"""Answers that need the centre of pressure along x, and along y."""


@inlined
def push(laws: Laws, borne: Records, angle_rad: float) -> None:
    """How much of each tile's force is vertical, as `upright`: all, unless a plate has told.

    Where it has, that is `1 + shear (1 - cos a)` with `a` between the tile's axis and the vertical,
    and what is left of that doubt is all tiles' alike. Where the segment's angle is not known, it
    is as if no plate had; of a tile that hardly faces the ground nothing is told.

    Args:
        laws: constants of the estimate.
        borne: what the tiles bear.
        angle_rad: of the segment.
    """
    scene, tiles = laws.scene[0], laws.tiles
    known = scene.sheared == 1 and not (scene.servo == 1 and math.isnan(angle_rad))
    turned_rad = angle_rad if scene.servo == 1 else 0.0
    for j in range(len(tiles)):
        now = borne[j]
        now.upright = 1.0
        if known and tiles[j].bears == 1:
            tilted = 1.0 - math.cos(tiles[j].axis_rad - turned_rad)
            now.upright = 1.0 + scene.shear * tilted
            if now.upright < UPRIGHT_LEAST:
                now.upright = 0.0
                continue
            now.common_n[PARTS - 1] = scene.shear_sigma * tilted * now.force_n / now.upright


@inlined
def stand(laws: Laws, borne: Records, out: Floats) -> None:
    """GRF, its sigma and bound, centre x, y, z, sigmas of x and y, to first order.

    Where a tile is missing or saturated there is neither GRF nor centre, but a bound: a tile bears
    at least what it states, and one that states nothing at least nothing.

    Args:
        laws: constants of the estimate.
        borne: what the tiles bear, and how much of it is upright.
        out: (`COLUMNS`,); its first seven columns, and `Z`, NaN where they stay.
    """
    tiles = laws.tiles
    total, stating, telling = 0.0, 0, 0
    for j in range(len(tiles)):
        now = borne[j]
        now.weight = 0.0
        if tiles[j].bears == 1 and not math.isnan(now.force_n) and now.upright > 0.0:
            total += now.upright * now.force_n
            now.weight = now.upright
            stating += 1
            telling += 1 - now.beyond
    sigma_n = sigma_of_sum(borne)
    if stating > 0:
        out[AT_LEAST] = total - BOUND_SIGMAS * sigma_n
    if telling < laws.scene[0].bearing:
        return
    out[GRF], out[GRF_SIGMA] = total, sigma_n
    if total == 0.0:
        return
    for axis, column in ((0, X), (1, Y), (2, Z)):
        moment = 0.0
        for j in range(len(tiles)):
            if tiles[j].bears == 1:
                moment += borne[j].upright * borne[j].force_n * tiles[j].place_m[axis]
        out[column] = moment / total
    for axis, column in ((0, X), (1, Y)):
        for j in range(len(tiles)):
            if tiles[j].bears == 1:
                arm_m = tiles[j].place_m[axis] - out[column]
                borne[j].weight = borne[j].upright * arm_m
        out[column + SIGMA_X - X] = sigma_of_sum(borne) / abs(total)


@inlined
def is_masked(laws: Laws, out: Floats) -> bool:
    """Would a centre of pressure be more doubtful than useful?"""
    scene = laws.scene[0]
    x_m, y_m, sigma_x_m, sigma_y_m = out[X], out[Y], out[SIGMA_X], out[SIGMA_Y]
    good = (
        out[GRF] >= SIGMAS * out[GRF_SIGMA]
        and sigma_x_m <= scene.cop_sigma_max_m
        and sigma_y_m <= scene.cop_sigma_max_m
    )
    for k in range(len(laws.hull)):
        nx, ny, offset_m = laws.hull[k]
        beyond_m = nx * x_m + ny * y_m - offset_m
        sigma_m = math.sqrt((nx * sigma_x_m) ** 2 + (ny * sigma_y_m) ** 2)
        # Noise about the edge is let through, or the mean of what is left would lie inside.
        good = good and beyond_m <= HULL_SIGMAS * sigma_m + 1e-9
    return not good


@inlined
def note_index(laws: Laws, cells: Records, out: Floats) -> None:
    """Paper eq. 4 to the letter: grid indices from 1, weighted by gauge pressure."""
    total_kpa = x = y = 0.0
    for j in range(len(laws.tiles)):
        law, gauge_kpa = laws.tiles[j], cells[j].gauge_kpa
        if law.bears == 1:
            total_kpa += gauge_kpa
            x += gauge_kpa * law.grid[0]
            y += gauge_kpa * law.grid[1]
    if total_kpa != 0.0:
        out[INDEX_X], out[INDEX_Y] = x / total_kpa, y / total_kpa
