"""The upper part of the ladder: force on every dome once the look-ahead is there, GRF and COP.

Whatever is summed here is summed over tiles, one after the other: numpy's own sum over an axis may
round in another order, and a matrix product does for one row and for many.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from devices.arrays import Arrays, Bools, Floats, Times
from devices.compiled import compiled
from service.estimation.ladder.averaged import averaged, summed
from service.estimation.ladder.chosen import Ladder
from service.estimation.ladder.lower import ApparentForces
from service.estimation.ladder.plan import EstimationPlan
from service.estimation.ladder.unseen import EVENLY, farthest, was_away
from service.estimation.models.flow import FlowState
from service.estimation.models.rubber import RubberState

BOUND_SIGMAS = 2.33
"""A stated bound lies so many standard uncertainties below: one in a hundred is above the truth."""


@dataclass(frozen=True)
class DomeState:
    """What a dome remembers; None for models that are not named, or have not begun."""

    plays_n: Floats | None = None
    flow: FlowState | None = None
    rubber: RubberState | None = None

    def is_same(self, other: DomeState) -> bool:
        """Does the other remember the same?"""
        if self.plays_n is not None and other.plays_n is not None:
            plays = np.array_equal(self.plays_n, other.plays_n)
        else:
            plays = self.plays_n is other.plays_n
        return plays and _same(self.flow, other.flow) and _same(self.rubber, other.rubber)


def _same(one: Arrays | None, other: Arrays | None) -> bool:
    if one is not None and other is not None:
        return one.is_same(other)
    return one is other


@dataclass(frozen=True)
class UpperState:
    """What the upper models remember."""

    dome: DomeState = DomeState()  # frozen, so one for all is safe
    dome_else: DomeState | None = None
    """After the forces farthest from those that were taken; None: nothing was unseen."""
    last_n: Floats | None = None
    """Forces of the frame before, ..."""
    last_ns: Times | None = None
    """... and its instants; None: there was none."""


@dataclass(frozen=True)
class TileForces:
    """Force on the bearing tiles and its standard uncertainty, (n, bearing tiles).

    Attributes:
        force_n: forces; where `beyond`, what they are at least if nothing is uncertain.
        sigma_n: their standard uncertainties.
        own_n: the part of these that is every tile's own.
        common_n: (parts, n, bearing tiles), the rest, of corrections of gas and rubber, of what
            either did unseen, of what averages smooth away of the load, of warmth that nothing
            corrects, and of when the bench's reference was read: all tiles share the error, so
            these are signed.
        beyond: where forces are only bounds.
        unsettled: (n,), has what was unseen left more than the noise of a reading in any tile?
    """

    force_n: Floats
    sigma_n: Floats
    own_n: Floats
    common_n: Floats
    beyond: Bools
    unsettled: Bools

    @property
    def stated_n(self) -> Floats:
        """Forces, or bounds that the truth exceeds in 99 of 100 frames."""
        return np.where(self.beyond, self.force_n - BOUND_SIGMAS * self.sigma_n, self.force_n)

    @property
    def stated_sigma_n(self) -> Floats:
        """Standard uncertainties; a bound has none."""
        return np.where(self.beyond, np.nan, self.sigma_n)


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
    bend_n = np.zeros(force_n.shape)
    if ladder.denoise:
        force_n, noise_n, bend_n, at_ns = averaged(plan, apparent, first, stop)
    own_n = np.sqrt(noise_n**2 + now.sigma_n**2)
    averaged_n = force_n
    force_n, unseen_n, state = _undone(plan, now, averaged_n, at_ns, state)
    rubber_n = ladder.rubber_misfit * (force_n - averaged_n)
    rate_n_per_s, state = _rate(force_n, at_ns, state)
    own_n = np.hypot(own_n, rate_n_per_s * plan.late_sigma_s)
    late_n = rate_n_per_s * plan.late_common_s
    common_n = np.stack(
        [now.gas_n, rubber_n, now.unseen_gas_n, unseen_n, bend_n, now.warm_n, late_n]
    )
    sigma_n = np.sqrt(own_n**2 + (common_n**2).sum(axis=0))
    unsettled = (~now.beyond & (np.hypot(now.unseen_gas_n, unseen_n) > now.noise_n)).any(axis=1)
    return TileForces(force_n, sigma_n, own_n, common_n, now.beyond, np.asarray(unsettled)), state


def _undone(
    plan: EstimationPlan, now: ApparentForces, force_n: Floats, at_ns: Times, state: UpperState
) -> tuple[Floats, Floats, UpperState]:
    """Forces without loop and creep, and their uncertainty from what the domes did unseen."""
    ladder, unseen = plan.ladder, plan.unseen
    if ladder.hysteresis is None and ladder.rubber is None:
        return force_n, np.zeros(force_n.shape), state
    before, borne_n = state.dome, None
    beyond, other, after_else = now.beyond.any(), state.dome_else, None
    if beyond:
        borne_n = now.guess_n
    out_n, after = _without_loop_and_creep(ladder, force_n, at_ns, before, borne_n, None)
    last_ns = at_ns[0]
    if (last := before.rubber or before.flow) is not None:
        last_ns = np.where(np.isnan(last.force_n), last_ns, last.t_ns)
    unseen_n = np.zeros(out_n.shape)
    if other is not None or beyond or was_away(~np.isnan(force_n), at_ns, last_ns):
        if beyond:
            borne_n = np.where(
                now.beyond, farthest(now.guess_n, now.apparent_n, unseen.most_n), np.nan
            )
        else_n, after_else = _without_loop_and_creep(
            ladder, force_n, at_ns, other or before, borne_n, unseen.end_n
        )
        unseen_n = np.where(now.beyond, 0.0, EVENLY * (else_n - out_n))
        out_n = np.where(now.beyond, np.minimum(out_n, else_n), out_n)
        if after_else.is_same(after):
            after_else = None
    return out_n, unseen_n, replace(state, dome=after, dome_else=after_else)


def _rate(force_n: Floats, at_ns: Times, state: UpperState) -> tuple[Floats, UpperState]:
    """How fast forces rise since the frame before in N/s; 0 where that is not known."""
    first_n = force_n[:1] if state.last_n is None else state.last_n[None]
    first_ns = at_ns[:1] if state.last_ns is None else state.last_ns[None]
    step_s = 1e-9 * np.diff(at_ns, axis=0, prepend=first_ns)
    rise_n = np.diff(force_n, axis=0, prepend=first_n)
    known = np.isfinite(rise_n) & (step_s > 0.0)
    rate = np.where(known, rise_n, 0.0) / np.where(known, step_s, 1.0)
    return rate, replace(state, last_n=force_n[-1].copy(), last_ns=at_ns[-1].copy())


def _without_loop_and_creep(
    ladder: Ladder,
    force_n: Floats,
    at_ns: Times,
    state: DomeState,
    borne_n: Floats | None,
    away_n: Floats | None,
) -> tuple[Floats, DomeState]:
    plays_n, flow, crept = state.plays_n, state.flow, state.rubber
    if ladder.flow is not None:
        flow = ladder.flow.at_rest() if flow is None else flow
        force_n, flow = ladder.flow.compensated(
            force_n, at_ns, flow, borne_n=borne_n, away_n=away_n
        )
    if ladder.hysteresis is not None:
        plays_n = ladder.hysteresis.at_rest() if plays_n is None else plays_n
        force_n, plays_n = ladder.hysteresis.compensated(force_n, plays_n, borne_n=borne_n)
    if ladder.rubber is not None:
        crept = ladder.rubber.at_rest() if crept is None else crept
        force_n, crept = ladder.rubber.compensated(
            force_n, at_ns, crept, borne_n=borne_n, away_n=away_n
        )
    return force_n, DomeState(plays_n, flow, crept)


@dataclass(frozen=True)
class Foot:
    """GRF and centre of pressure of n frames with their standard uncertainties, each (n,).

    `at_least_n` is what the truth exceeds in 99 of 100 frames: NaN only if no tile is known.
    """

    grf_n: Floats
    grf_sigma_n: Floats
    at_least_n: Floats
    cop_m: tuple[Floats, Floats, Floats]
    cop_sigma_m: tuple[Floats, Floats]


def foot_of(plan: EstimationPlan, tiles: TileForces) -> Foot:
    """Sum of the tile forces, and the force-weighted mean of the tiles' places.

    Where a tile is missing or saturated there is neither, but a bound: a tile bears at least what
    it states, and one that states nothing at least nothing.
    """
    # Whether the ground pushes along the axes of tiles or along the segment, no tile can tell.
    tilted_n = plan.tilted * tiles.force_n
    common_n = np.concatenate([tiles.common_n, tilted_n[None]])
    columns = _foot(tiles.force_n, tiles.own_n, common_n, tiles.beyond, plan.bearing_m)
    grf_n, sigma_n, at_least_n, x_m, y_m, z_m, sigma_x_m, sigma_y_m = columns.T
    return Foot(grf_n, sigma_n, at_least_n, (x_m, y_m, z_m), (sigma_x_m, sigma_y_m))


@compiled
def _foot(
    force_n: Floats, own_n: Floats, common_n: Floats, beyond: Bools, places_m: Floats
) -> Floats:
    """GRF, its sigma and bound, centre x, y, z, sigmas of x and y, to first order: (n, 8)."""
    n, tiles = force_n.shape
    out = np.full((n, 8), math.nan)
    weights = np.empty(tiles)
    for i in range(n):
        total, stating, telling = 0.0, 0, 0
        for j in range(tiles):
            weights[j] = 0.0
            if not math.isnan(force_n[i, j]):
                total += force_n[i, j]
                weights[j] = 1.0
                stating += 1
                telling += not beyond[i, j]
        sigma = _sigma(own_n, common_n, i, weights)
        if stating > 0:
            out[i, 2] = total - BOUND_SIGMAS * sigma
        if telling < tiles:
            continue
        out[i, 0], out[i, 1] = total, sigma
        if total == 0.0:
            continue
        for axis in range(3):
            moment = 0.0
            for j in range(tiles):
                moment += force_n[i, j] * places_m[j, axis]
            out[i, 3 + axis] = moment / total
        for axis in range(2):
            for j in range(tiles):
                weights[j] = places_m[j, axis] - out[i, 3 + axis]
            out[i, 6 + axis] = _sigma(own_n, common_n, i, weights) / abs(total)
    return out


@compiled
def _sigma(own_n: Floats, common_n: Floats, i: int, weights: Floats) -> float:
    """Of a weighted sum over the tiles of frame `i`: own parts add as squares, others as is.

    A tile without weight may be unknown.
    """
    variance = 0.0
    for j in range(len(weights)):
        if weights[j] != 0.0:
            variance += (weights[j] * own_n[i, j]) ** 2
    for part in range(len(common_n)):
        shared = 0.0
        for j in range(len(weights)):
            if weights[j] != 0.0:
                shared += weights[j] * common_n[part, i, j]
        variance += shared * shared
    return math.sqrt(variance)


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
