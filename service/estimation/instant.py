"""What one frame says by itself: tile forces, GRF, COP, each with its uncertainty and flags.

No memory, and the same bits for one row as for many: nothing is summed over time, multiplied as a
matrix, or dependent on how rows lie in memory.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from devices.frames import FrameBatch
from devices.mpl115a2 import PRESSURE_MAX_KPA, PRESSURE_MIN_KPA
from service.estimation.contact import UNKNOWN
from service.estimation.drift import has_warmed
from service.estimation.estimates import Estimates, EstimateStatus
from service.estimation.models.unwrap import unwrap
from service.estimation.plan import SIGMAS, TARE_OLD_NS, EstimationPlan

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class _TileForces:
    """What every tile says by itself; arrays (n, tiles), NaN for tiles that bear no load."""

    gauge_kpa: Floats
    force_n: Floats
    sigma_n: Floats
    flags: dict[EstimateStatus, npt.NDArray[np.bool_]]


def estimate_instants(
    plan: EstimationPlan, frames: FrameBatch, after_gap: npt.NDArray[np.bool_]
) -> tuple[Estimates, Floats]:
    """All that follows from each frame alone.

    Contact is left unknown, so is where the foot stands, and no COP is masked.

    Args:
        plan: constants of the estimate.
        frames: n frames.
        after_gap: (n,), which of them come after a gap.

    Returns:
        The estimates, and the height z of their centre of pressure in the foot frame, in metres.
    """
    tiles = _tile_forces(plan, frames)
    bearing = np.flatnonzero(plan.bears)
    grf_n = _sum(tiles.force_n, bearing)
    (x_m, y_m, z_m), (sigma_x_m, sigma_y_m, _) = _centre_of_pressure(plan, tiles, grf_n, bearing)
    index_x, index_y = _grid_index(plan, tiles.gauge_kpa, bearing)
    unknown = np.full(len(frames), np.nan)
    estimates = Estimates(
        seq=frames.seq,
        t_ns=frames.t_ns,
        gauge_kpa=tiles.gauge_kpa,
        force_n=tiles.force_n,
        force_sigma_n=tiles.sigma_n,
        grf_n=grf_n,
        grf_sigma_n=np.sqrt(_sum(tiles.sigma_n**2, bearing)),
        cop_x_m=x_m,
        cop_y_m=y_m,
        cop_sigma_x_m=sigma_x_m,
        cop_sigma_y_m=sigma_y_m,
        cop_index_x=index_x,
        cop_index_y=index_y,
        cop_ground_x_m=unknown,
        cop_ground_y_m=unknown,
        angle_rad=unknown,
        contact=np.full(len(frames), UNKNOWN, dtype=np.uint8),
        estimate_status=_status(plan, frames, tiles, bearing, after_gap),
    )
    return estimates, z_m


def _tile_forces(plan: EstimationPlan, frames: FrameBatch) -> _TileForces:
    kpa = plan.compensation.readable_kpa(frames)
    if "unwrap" in plan.models:
        kpa = unwrap(kpa, plan.compensation.kpa_per_count(frames.tadc))
    missing = ~(kpa >= PRESSURE_MIN_KPA)
    gauge_kpa = np.where(missing, np.nan, kpa - plan.tare.baseline_kpa)
    static = plan.curves.force(gauge_kpa)
    still_kpa = np.sqrt(plan.tare.noise_kpa**2 + plan.tare.baseline_sigma_kpa**2)
    sigma_n = np.sqrt((static.slope_n_per_kpa * still_kpa) ** 2 + static.fit_sigma_n**2)
    saturated = gauge_kpa > plan.curves.high_kpa
    return _TileForces(
        gauge_kpa=gauge_kpa,
        force_n=np.where(plan.bears, static.force_n, np.nan),
        # A lower bound has no standard uncertainty.
        sigma_n=np.where(plan.bears & ~saturated, sigma_n, np.nan),
        flags={
            EstimateStatus.SATURATED: saturated,
            EstimateStatus.EXTRAPOLATED: gauge_kpa < plan.curves.low_kpa - SIGMAS * still_kpa,
            EstimateStatus.OVER_RATED: (kpa > PRESSURE_MAX_KPA) & ~saturated,
            EstimateStatus.TILE_MISSING: missing,
        },
    )


def _centre_of_pressure(
    plan: EstimationPlan, tiles: _TileForces, grf_n: Floats, bearing: npt.NDArray[np.intp]
) -> tuple[list[Floats], list[Floats]]:
    """Force-weighted mean of the tiles' places along x, y and z, and its first-order sigma."""
    divisor_n = np.where(grf_n == 0.0, np.nan, grf_n)
    centre_m, sigma_m = [], []
    for axis in range(3):
        arm_m = plan.positions_m[:, axis]
        at_m = _sum(tiles.force_n * arm_m, bearing) / divisor_n
        variance = _sum(((arm_m - at_m[:, None]) * tiles.sigma_n) ** 2, bearing)
        centre_m.append(at_m)
        sigma_m.append(np.sqrt(variance) / np.abs(divisor_n))
    return centre_m, sigma_m


def _status(
    plan: EstimationPlan,
    frames: FrameBatch,
    tiles: _TileForces,
    bearing: npt.NDArray[np.intp],
    after_gap: npt.NDArray[np.bool_],
) -> npt.NDArray[np.uint16]:
    status = np.zeros(len(frames), dtype=np.uint16)
    for bit, flagged in tiles.flags.items():
        status[flagged[:, bearing].any(axis=1)] |= np.uint16(bit)
    status[after_gap] |= np.uint16(EstimateStatus.GAP)
    doubtful = frames.t_ns - plan.tare.t_ns > TARE_OLD_NS
    if "temperature" not in plan.models:
        known = ~tiles.flags[EstimateStatus.TILE_MISSING]
        doubtful |= (known & has_warmed(plan.tare, frames.tadc))[:, bearing].any(axis=1)
    status[doubtful] |= np.uint16(EstimateStatus.TARE_OLD)
    if plan.assumed_scale:
        status |= np.uint16(EstimateStatus.ASSUMED_SCALE)
    return status


def _grid_index(
    plan: EstimationPlan, gauge_kpa: Floats, bearing: npt.NDArray[np.intp]
) -> tuple[Floats, Floats]:
    """Paper eq. 4 to the letter: grid indices from 1, weighted by gauge pressure."""
    if plan.grid is None:
        nothing = np.full(len(gauge_kpa), np.nan)
        return nothing, nothing
    total_kpa = _sum(gauge_kpa, bearing)
    divisor_kpa = np.where(total_kpa == 0.0, np.nan, total_kpa)
    x, y = (
        _sum(gauge_kpa[:, bearing] * index, range(len(bearing))) / divisor_kpa
        for index in plan.grid
    )
    return x, y


def _sum(values: Floats, tiles: npt.NDArray[np.intp] | range) -> Floats:
    # One tile after the other: numpy's own sum over an axis may round in another order.
    total = np.zeros(len(values))
    for tile in tiles:
        total = total + values[:, tile]
    return total
