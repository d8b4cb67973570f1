"""`hysteresis`: the rubber's loop, which does not depend on speed (hardware.md 9).

The apparent force lags behind F by the sum of a few play operators::

    apparent = F + sum w (y - F),  y kept within F -+ min(r, OPENS F)

each a part w of the force with a play of half width r; near zero load the branches meet. Solved for
F at every sample. A play operator moves with every reversal, and so with noise: that is why this
comes after `denoise`.
"""

from __future__ import annotations

import math
from typing import Annotated, Self

import numpy as np

from devices.arrays import Floats
from devices.errors import CalibrationError
from devices.jit import jit_cached
from service.estimation.effects import parameter_values
from service.estimation.models import LoadBearingTiles, ModelParams, flow
from service.estimation.models.flow import FlowParams, FlowState
from service.estimation.records import KernelRecord, RecordArray

WIDTHS_N = np.array([0.6, 1.5, 4.0])
"""Half widths of the plays; their weights are fitted."""
LOOP_OPENING = 0.4
_ITERATIONS = 100  # a bound; see `_solve_force`
_CLOSE = 1e-14
"""Smallest relative step of the iteration."""
PLAYS = len(WIDTHS_N)


class HysteresisParams(ModelParams):
    """Parameters of a tile; zero for a tile whose calibration has no loop."""

    effect = "hysteresis"

    play_weights: Annotated[Floats, (PLAYS,)]  # of half widths `WIDTHS_N`; in sum below 1
    has_flow: int  # 1: the calibration of any tile has a viscous branch
    flow: FlowParams

    @classmethod
    def make(cls, tiles: LoadBearingTiles) -> RecordArray[Self]:
        """Make the parameters of load-bearing tiles, (tiles,).

        Raises:
            CalibrationError: a tile has another number of plays.
        """
        found = [tile.effects.hysteresis for tile in tiles.calibrations]
        plays = {len(effect.part) for effect in found if effect is not None}
        if plays != {PLAYS}:
            raise CalibrationError(
                f"its tiles have {sorted(plays)} plays",
                where=tiles.calibration_label,
                expected=f"{PLAYS} plays",
                remedy="Calibrate all of them with this version",
            )
        made = cls.array(len(found))
        for i, effect in enumerate(found):
            if effect is not None:
                made["play_weights"][i] = parameter_values(effect.part)
            if effect is not None and (branch := effect.flow) is not None:
                made["has_flow"] = 1
                made["flow"][i] = branch.part.value, branch.stress_n.value, branch.power.value
        return made


class HysteresisState(KernelRecord):
    """State of a tile's plays and viscous branch."""

    plays_n: Annotated[Floats, (PLAYS,)]
    flow: FlowState


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
def settle_state(
    params: HysteresisParams, state: HysteresisState, force_n: float, highest_n: float, t_ns: int
) -> None:
    """Set the state of a dome that has borne a force until `t_ns`, and before a higher one or none.

    Args:
        params: of the tile.
        state: set.
        force_n: the force, by which the viscous branch has relaxed.
        highest_n: the plays are where they were after this one.
        t_ns: instant of the next reading.
    """
    if params.has_flow == 1:
        flow.settle_state(state.flow, force_n, t_ns)
    for m in range(PLAYS):
        state.plays_n[m] = highest_n


@jit_cached
def copy_state(state: HysteresisState, to: HysteresisState) -> None:
    """Copy a state into another."""
    flow.copy_state(state.flow, to.flow)
    for m in range(PLAYS):
        to.plays_n[m] = state.plays_n[m]


@jit_cached
def is_same_state(params: HysteresisParams, one: HysteresisState, other: HysteresisState) -> bool:
    """Return whether two states are equal."""
    for m in range(PLAYS):
        if one.plays_n[m] != other.plays_n[m]:
            return False
    return params.has_flow == 0 or flow.is_same_state(one.flow, other.flow)


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
