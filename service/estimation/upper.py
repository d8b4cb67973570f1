"""The upper part of the ladder: force on every dome once the look-ahead is there, GRF and COP.

Whatever is summed here is summed over tiles, one after the other: numpy's own sum over an axis may
round in another order, and a matrix product does for one row and for many.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from devices.arrays import Floats
from service.estimation.compiled import compiled
from service.estimation.lower import ApparentForces
from service.estimation.models import denoise
from service.estimation.models.rubber import RubberState
from service.estimation.plan import EstimationPlan


@dataclass(frozen=True)
class UpperState:
    """What the upper models remember; None for those that are not named, or have not begun."""

    plays_n: Floats | None = None
    rubber: RubberState | None = None


@dataclass(frozen=True)
class TileForces:
    """Force on the bearing tiles and its standard uncertainty, (n, bearing tiles).

    Attributes:
        force_n: forces.
        sigma_n: standard uncertainties.
        own_n: their part that is every tile's own.
        common_n: the rest, of gas and of rubber: all tiles share the error, so these are signed.
    """

    force_n: Floats
    sigma_n: Floats
    own_n: Floats
    common_n: tuple[Floats, Floats]


def tile_forces(
    plan: EstimationPlan, apparent: ApparentForces, first: int, stop: int, state: UpperState
) -> tuple[TileForces, UpperState]:
    """Forces in frames `first` to `stop`.

    Args:
        plan: constants of the estimate.
        apparent: in these frames, in those before them that are still needed, and in those ahead.
        first: row.
        stop: row after the last.
        state: from the frames before.
    """
    ladder, now = plan.ladder, apparent.rows(first, stop)
    force_n, noise_n, at_ns = now.apparent_n, now.noise_n, now.sampled_ns
    if ladder.denoise:
        # A lower bound would be averaged with what is no bound.
        usable_n = np.where(apparent.beyond, np.nan, apparent.apparent_n)
        asked_ns = apparent.sampled_ns
        if ladder.skew:
            asked_ns = np.broadcast_to(apparent.t_mono_ns[:, None], asked_ns.shape)
            at_ns = asked_ns[first:stop]
        averaged_n, left = denoise.denoised(
            np.ascontiguousarray(usable_n),
            np.ascontiguousarray(apparent.noise_n),
            np.ascontiguousarray(apparent.sampled_ns),
            np.ascontiguousarray(apparent.t_mono_ns),
            np.ascontiguousarray(asked_ns),
            np.ascontiguousarray(apparent.run),
            first,
            stop,
            plan.look_ns,
            denoise.PAST_NS,
            denoise.REACHES,
            denoise.AGREE,
            plan.noise_left,
        )
        force_n = np.where(np.isnan(averaged_n), force_n, averaged_n)
        noise_n = noise_n * np.sqrt(np.where(np.isnan(left), 1.0, left))
    own_n = np.sqrt(noise_n**2 + now.sigma_n**2)
    averaged_n = force_n
    if ladder.hysteresis is not None:
        plays_n = ladder.hysteresis.at_rest() if state.plays_n is None else state.plays_n
        force_n, plays_n = ladder.hysteresis.compensated(force_n, plays_n)
        state = replace(state, plays_n=plays_n)
    if ladder.rubber is not None:
        before = ladder.rubber.at_rest() if state.rubber is None else state.rubber
        force_n, crept = ladder.rubber.compensated(force_n, at_ns, before)
        state = replace(state, rubber=crept)
    rubber_n = ladder.rubber_misfit * (force_n - averaged_n)
    # A lower bound has no standard uncertainty.
    own_n = np.where(now.beyond, np.nan, own_n)
    sigma_n = np.sqrt(own_n**2 + now.gas_n**2 + rubber_n**2)
    return TileForces(force_n, sigma_n, own_n, (now.gas_n, rubber_n)), state


@dataclass(frozen=True)
class Foot:
    """GRF and centre of pressure of n frames with their standard uncertainties, each (n,)."""

    grf_n: Floats
    grf_sigma_n: Floats
    cop_m: tuple[Floats, Floats, Floats]
    cop_sigma_m: tuple[Floats, Floats]


def foot_of(plan: EstimationPlan, tiles: TileForces) -> Foot:
    """Sum of the tile forces, and the force-weighted mean of the tiles' places."""
    columns = _foot(tiles.force_n, tiles.own_n, *tiles.common_n, plan.bearing_m)
    grf_n, sigma_n, x_m, y_m, z_m, sigma_x_m, sigma_y_m = columns.T
    return Foot(grf_n, sigma_n, (x_m, y_m, z_m), (sigma_x_m, sigma_y_m))


@compiled
def _foot(
    force_n: Floats, own_n: Floats, gas_n: Floats, rubber_n: Floats, places_m: Floats
) -> Floats:
    """GRF and its sigma, centre x, y, z, and the sigmas of x and y, to first order: (n, 7)."""
    n, tiles = force_n.shape
    out = np.full((n, 7), math.nan)
    for i in range(n):
        total = own = gas = rubber = 0.0
        for j in range(tiles):
            total += force_n[i, j]
            own += own_n[i, j] * own_n[i, j]
            gas += gas_n[i, j]
            rubber += rubber_n[i, j]
        out[i, 0], out[i, 1] = total, math.sqrt(own + gas * gas + rubber * rubber)
        if total == 0.0:
            continue
        for axis in range(3):
            moment = 0.0
            for j in range(tiles):
                moment += force_n[i, j] * places_m[j, axis]
            out[i, 2 + axis] = moment / total
        for axis in range(2):
            own = gas = rubber = 0.0
            for j in range(tiles):
                arm_m = places_m[j, axis] - out[i, 2 + axis]
                own += (arm_m * own_n[i, j]) ** 2
                gas += arm_m * gas_n[i, j]
                rubber += arm_m * rubber_n[i, j]
            out[i, 5 + axis] = math.sqrt(own + gas * gas + rubber * rubber) / abs(total)
    return out


def grid_index(plan: EstimationPlan, gauge_kpa: Floats) -> tuple[Floats, Floats]:
    """Paper eq. 4 to the letter: grid indices from 1, weighted by gauge pressure."""
    if plan.grid is None:
        nothing = np.full(len(gauge_kpa), np.nan)
        return nothing, nothing
    weight_kpa = np.ascontiguousarray(gauge_kpa[:, plan.bearing])
    total_kpa = summed(weight_kpa)
    divisor_kpa = np.where(total_kpa == 0.0, np.nan, total_kpa)
    x, y = (summed(weight_kpa * index) / divisor_kpa for index in plan.grid)
    return x, y


@compiled
def summed(values: Floats) -> Floats:
    """Sum over tiles, (n,)."""
    n, tiles = values.shape
    total = np.zeros(n)
    for i in range(n):
        for tile in range(tiles):
            total[i] += values[i, tile]
    return total
