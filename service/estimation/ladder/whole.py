"""The foot as a whole: GRF and centre of pressure of one frame, from what its tiles bear."""

from __future__ import annotations

import math

from devices.arrays import Floats
from devices.compiled import inlined
from service.estimation.ladder.laws import Laws
from service.estimation.ladder.plan import SIGMAS
from service.estimation.ladder.upper import BOUND_SIGMAS, sigma_of_sum
from service.estimation.records import Records

HULL_SIGMAS = 3.0  # noise about the edge of the tiles is no reason to mask
GRF, GRF_SIGMA, AT_LEAST, X, Y, SIGMA_X, SIGMA_Y, INDEX_X, INDEX_Y, GROUND_X, GROUND_Y, ANGLE, Z = (
    range(13)
)
"""Places of the answers in a row of `stand`; the last is needed for the ground only."""
COLUMNS = 13


@inlined
def stand(laws: Laws, borne: Records, out: Floats) -> None:
    """GRF, its sigma and bound, centre x, y, z, sigmas of x and y, to first order.

    Where a tile is missing or saturated there is neither GRF nor centre, but a bound: a tile bears
    at least what it states, and one that states nothing at least nothing.

    Args:
        laws: constants of the estimate.
        borne: what the tiles bear.
        out: (`COLUMNS`,), NaN throughout; its first seven columns, and `Z`.
    """
    tiles = laws.tiles
    total, stating, telling = 0.0, 0, 0
    for j in range(len(tiles)):
        now = borne[j]
        now.weight = 0.0
        if tiles[j].bears == 1 and not math.isnan(now.force_n):
            total += now.force_n
            now.weight = 1.0
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
                moment += borne[j].force_n * tiles[j].place_m[axis]
        out[column] = moment / total
    for axis, column in ((0, X), (1, Y)):
        for j in range(len(tiles)):
            if tiles[j].bears == 1:
                borne[j].weight = tiles[j].place_m[axis] - out[column]
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
