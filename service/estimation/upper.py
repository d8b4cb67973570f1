"""The upper part of the ladder: force on every dome once the look-ahead is there, GRF and COP.

Whatever is summed here is summed over tiles, one after the other: numpy's own sum over an axis may
round in another order, and a matrix product does for one row and for many.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from service.estimation.lower import Felt
from service.estimation.models import denoise
from service.estimation.models.rubber import RubberState
from service.estimation.plan import EstimationPlan

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class UpperState:
    """What the upper models remember; None for those that are not named, or have not begun."""

    plays_n: Floats | None = None
    rubber: RubberState | None = None


@dataclass(frozen=True)
class Forces:
    """Force on the bearing tiles and its standard uncertainty, (n, bearing tiles).

    Attributes:
        force_n: forces.
        sigma_n: standard uncertainties.
        own_n: their part that is every tile's own.
        common_n: the rest, one array for each effect that all tiles share the error of, signed.
    """

    force_n: Floats
    sigma_n: Floats
    own_n: Floats
    common_n: tuple[Floats, ...]


def forces(
    plan: EstimationPlan,
    known: Felt,
    frame_t_ns: npt.NDArray[np.int64],
    run: npt.NDArray[np.int64],
    first: int,
    stop: int,
    state: UpperState,
) -> tuple[Forces, UpperState]:
    """Forces in frames `first` to `stop` of those known.

    Args:
        plan: constants of the estimate.
        known: these frames, those before them that are still needed, and those ahead.
        frame_t_ns: (n,), instants of all of them on the monotonic clock.
        run: (n,), number of the unbroken run that each belongs to.
        first: row.
        stop: row after the last.
        state: from the frames before.
    """
    ladder, now = plan.ladder, known.rows(first, stop)
    felt_n, noise_n = now.felt_n, now.noise_n
    t_mono_ns = now.t_mono_ns
    if ladder.denoise:
        # A lower bound would be averaged with what is no bound.
        usable_n = np.where(known.beyond, np.nan, known.felt_n)
        at_ns = known.t_mono_ns
        if ladder.skew:
            at_ns = np.broadcast_to(frame_t_ns[:, None], at_ns.shape)
            t_mono_ns = at_ns[first:stop]
        averaged_n, left = denoise.denoised(
            np.ascontiguousarray(usable_n),
            np.ascontiguousarray(known.noise_n),
            np.ascontiguousarray(known.t_mono_ns),
            np.ascontiguousarray(frame_t_ns),
            np.ascontiguousarray(at_ns),
            np.ascontiguousarray(run),
            first,
            stop,
            plan.look_ns,
            denoise.PAST_NS,
            denoise.REACHES,
            denoise.AGREE,
        )
        felt_n = np.where(np.isnan(averaged_n), felt_n, averaged_n)
        noise_n = noise_n * np.sqrt(np.where(np.isnan(left), 1.0, left))
    own_n = np.sqrt(noise_n**2 + now.sigma_n**2)
    averaged_n = felt_n
    if ladder.hysteresis is not None:
        plays_n = ladder.hysteresis.at_rest() if state.plays_n is None else state.plays_n
        felt_n, plays_n = ladder.hysteresis.unfelt(felt_n, plays_n)
        state = replace(state, plays_n=plays_n)
    if ladder.rubber is not None:
        before = ladder.rubber.at_rest() if state.rubber is None else state.rubber
        felt_n, crept = ladder.rubber.unfelt(felt_n, t_mono_ns, before)
        state = replace(state, rubber=crept)
    rubber_n = ladder.rubber_misfit * (felt_n - averaged_n)
    # A lower bound has no standard uncertainty.
    own_n = np.where(now.beyond, np.nan, own_n)
    sigma_n = np.sqrt(own_n**2 + now.gas_n**2 + rubber_n**2)
    return Forces(felt_n, sigma_n, own_n, (now.gas_n, rubber_n)), state


@dataclass(frozen=True)
class Foot:
    """GRF and centre of pressure of n frames with their standard uncertainties, each (n,)."""

    grf_n: Floats
    grf_sigma_n: Floats
    cop_m: tuple[Floats, Floats, Floats]
    cop_sigma_m: tuple[Floats, Floats, Floats]


def foot_of(plan: EstimationPlan, tiles: Forces) -> Foot:
    """Sum of the tile forces, and the force-weighted mean of the tiles' places."""
    grf_n = summed(tiles.force_n)
    divisor_n = np.where(grf_n == 0.0, np.nan, grf_n)
    centre_m, sigma_m = [], []
    for axis in range(3):
        arm_m = plan.positions_m[plan.bearing, axis]
        at_m = summed(tiles.force_n * arm_m) / divisor_n
        centre_m.append(at_m)
        sigma_m.append(_sigma_of_sum(tiles, arm_m - at_m[:, None]) / np.abs(divisor_n))
    return Foot(
        grf_n=grf_n,
        grf_sigma_n=_sigma_of_sum(tiles, np.ones(tiles.force_n.shape)),
        cop_m=(centre_m[0], centre_m[1], centre_m[2]),
        cop_sigma_m=(sigma_m[0], sigma_m[1], sigma_m[2]),
    )


def _sigma_of_sum(tiles: Forces, weights: Floats) -> Floats:
    """Standard uncertainty of a weighted sum over tiles, (n,), to first order."""
    variance = summed((weights * tiles.own_n) ** 2)
    for common_n in tiles.common_n:
        variance = variance + summed(weights * common_n) ** 2
    return np.sqrt(variance)


def grid_index(plan: EstimationPlan, gauge_kpa: Floats) -> tuple[Floats, Floats]:
    """Paper eq. 4 to the letter: grid indices from 1, weighted by gauge pressure."""
    if plan.grid is None:
        nothing = np.full(len(gauge_kpa), np.nan)
        return nothing, nothing
    weight_kpa = gauge_kpa[:, plan.bearing]
    total_kpa = summed(weight_kpa)
    divisor_kpa = np.where(total_kpa == 0.0, np.nan, total_kpa)
    x, y = (summed(weight_kpa * index) / divisor_kpa for index in plan.grid)
    return x, y


def summed(values: Floats) -> Floats:
    """Sum over tiles, (n,)."""
    total = np.zeros(len(values))
    for tile in range(values.shape[1]):
        total = total + values[:, tile]
    return total
