"""`hysteresis`: the rubber's loop, which does not depend on speed (hardware.md 9).

The apparent force lags behind F by the sum of a few play operators::

    apparent = F + sum w (y - F),  y kept within F -+ min(r, OPENS F)

each a part w of the force with a play of half width r; near zero load the branches meet. Solved for
F at every sample. A play operator moves with every reversal, and so with noise: that is why this
comes after `denoise`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from devices.arrays import Floats
from devices.jit import jit_cached
from service.estimation.records import KernelRecord, RecordArray

WIDTHS_N = np.array([0.6, 1.5, 4.0])
"""Half widths of the plays; their weights are fitted."""
LOOP_OPENING = 0.4
_ITERATIONS = 100  # a bound; see `_solve_force`
_CLOSE = 1e-14
"""Smallest relative step of the iteration."""
PLAYS = len(WIDTHS_N)


class HysteresisParams(KernelRecord):
    """Parameters of a tile, as in `HysteresisModel`."""

    play_weights: Annotated[Floats, (PLAYS,)]


class HysteresisState(KernelRecord):
    """State of a tile's plays."""

    plays_n: Annotated[Floats, (PLAYS,)]


def initial_state(tiles: int) -> RecordArray[HysteresisState]:
    """Make the states before the first reading, (tiles,)."""
    return HysteresisState.array(tiles)


@dataclass(frozen=True)
class HysteresisModel:
    """Weights (tiles, plays) of the plays of half widths `WIDTHS_N`; in sum below 1."""

    play_weights: Floats

    def to_records(self) -> RecordArray[HysteresisParams]:
        """Make the kernel's parameters, (tiles,)."""
        return HysteresisParams.array(len(self.play_weights), play_weights=self.play_weights)


@jit_cached
def compensate_hysteresis(
    params: HysteresisParams, state: HysteresisState, apparent_n: float, state_override_n: float
) -> float:
    """Correct an apparent force for hysteresis; update the state. NaN changes nothing.

    Args:
        params: of the tile.
        state: plays before; updated.
        apparent_n: apparent force.
        state_override_n: force that moves the plays instead of the returned one; NaN: that one.
    """
    if not math.isfinite(apparent_n):
        return math.nan
    found = _solve_force(apparent_n, params.play_weights, state.plays_n)
    force = found if math.isnan(state_override_n) else state_override_n
    for m in range(PLAYS):
        state.plays_n[m] = step_play_closed_at_zero_load(force, WIDTHS_N[m], state.plays_n[m])
    return found


@jit_cached
def step_play_closed_at_zero_load(force_n: float, half_width_n: float, before: float) -> float:
    """Return a play after a force; it lags behind by no more than its width allows."""
    half = min(half_width_n, LOOP_OPENING * max(force_n, 0.0))
    return min(max(before, force_n - half), force_n + half)


@jit_cached
def _solve_force(apparent: float, weights: Floats, plays: Floats) -> float:
    """Solve for the force that gives `apparent` with these plays.

    The apparent force is piecewise linear over the force and rises with it. Newton's method ends on
    the right piece after a few steps; halving an interval around the force prevents cycles.
    """
    if apparent <= 0.0:  # all plays are closed
        return apparent
    low, high, force = 0.0, math.inf, apparent
    for _ in range(_ITERATIONS):
        value, slope = force, 1.0
        for m in range(PLAYS):
            value += weights[m] * (
                step_play_closed_at_zero_load(force, WIDTHS_N[m], plays[m]) - force
            )
            slope += weights[m] * _play_slope(force, WIDTHS_N[m], plays[m])
        if value > apparent:
            high = force
        else:
            low = force
        better = force - (value - apparent) / slope
        if abs(better - force) <= _CLOSE * force:
            return better
        force = better if low < better < high else 0.5 * (low + min(high, 2.0 * force))
    return force


@jit_cached
def _play_slope(force: float, width: float, before: float) -> float:
    """Return the slope of a play's distance from the force over the force."""
    half = min(width, LOOP_OPENING * force)
    if force - half <= before <= force + half:
        return -1.0
    opening = LOOP_OPENING if half < width else 0.0
    return opening if before > force else -opening
