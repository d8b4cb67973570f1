"""`hysteresis`, the part that depends on speed: a branch of the rubber that flows (hardware.md 9).

Beside the spring a branch bears part g of every change of the force F and flows, the faster the
more it bears; the bubble gets the rest (Bergstrom and Boyce 1998, J. Mech. Phys. Solids 46: the
rate of flow goes with a power n of the stress, about the fourth)::

    apparent = F - s,  ds/dt = g dF/dt - g R |s/S|^n sign(s)

so that under a force that changes by R for long s is S. The flow alone has a closed form; it stands
between two halves of the step in force, which is stable for any step and as exact as the force is
linear. Solved for F at every sample, because s depends on it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from devices.arrays import Floats
from devices.compiled import compiled
from service.estimation.foot import UNSEEN_NS
from service.estimation.records import Record, Records, record_type, records

STROKE_N_PER_S = 10.0
"""R: about that of a bench's slow stroke, so that what is fitted is what the stroke shows."""
_ITERATIONS = 50  # a bound; three to five are the rule
_CLOSE = 1e-14  # of the force, or of a newton
LAW = record_type([("part", np.float64), ("stress_n", np.float64), ("power", np.float64)])
"""Constants of a tile, as in `Flow`."""
STATE = record_type([("stress_n", np.float64), ("force_n", np.float64), ("t_ns", np.int64)])
"""Of a tile: what the branch bears, and the force before (NaN: none)."""


def at_rest(tiles: int) -> Records:
    """Before the first reading."""
    return records(STATE, tiles, force_n=np.nan)


@dataclass(frozen=True)
class Flow:
    """Parameters over tiles.

    Attributes:
        part: g, of a change of force that the branch bears at first; `FlowEffect` bounds it.
        stress_n: S, what it bears of a force that changes by `STROKE_N_PER_S`.
        power: n, above 1.
    """

    part: Floats
    stress_n: Floats
    power: Floats

    def laws(self) -> Records:
        """The constants, tile by tile."""
        return records(LAW, len(self.part), **vars(self))


@compiled
def compensated(
    law: Record, state: Record, apparent_n: float, t_ns: int, borne_n: float, away_n: float
) -> float:
    """Force that appears as this; NaN stays NaN and changes nothing after it.

    Args:
        law: constants of the tile.
        state: from its readings before; becomes that after this one.
        apparent_n: force that appears.
        t_ns: instant.
        borne_n: force under which the branch flows, whatever the apparent one says; NaN: what that
            says.
        away_n: force that may have been borne while there was no reading for more than
            `UNSEEN_NS`: it or nothing was, whichever is farther from the straight line; NaN: the
            straight line.
    """
    if not math.isfinite(apparent_n):
        return math.nan
    if math.isnan(state.force_n):  # the first reading: at rest without a force
        state.force_n, state.t_ns = 0.0, t_ns
    before, stress, passed_ns = state.force_n, state.stress_n, t_ns - state.t_ns
    dt = max(0.0, passed_ns * 1e-9)
    if away_n > 0.0 and passed_ns > UNSEEN_NS:  # until just now
        before = away_n if before + apparent_n < away_n else 0.0
        stress, dt = 0.0, 0.0
    found: float = _inverted(apparent_n, before, stress, law.part, law.stress_n, law.power, dt)
    now = found if math.isnan(borne_n) else borne_n
    state.stress_n = flowed(stress, law.part, law.stress_n, law.power, now - before, dt)
    state.force_n, state.t_ns = now, t_ns
    return found


@compiled
def flowed(
    stress: float, part: float, stress_n: float, power: float, rise: float, dt: float
) -> float:
    """What the branch bears after a step of the force by `rise` within `dt`."""
    half = 0.5 * part * rise
    between = stress + half
    spread = _spread(between, part, stress_n, power, dt)
    return float(between * spread ** (1.0 / (1.0 - power)) + half)


@compiled
def _spread(stress: float, part: float, stress_n: float, power: float, dt: float) -> float:
    """(s(0)/s(t))^(n - 1) of the flow alone, within `dt`."""
    fast_per_s = (power - 1.0) * part * STROKE_N_PER_S / stress_n
    spread: float = 1.0 + fast_per_s * dt * (abs(stress) / stress_n) ** (power - 1.0)
    return spread


@compiled
def _inverted(
    apparent: float,
    before: float,
    stress: float,
    part: float,
    stress_n: float,
    power: float,
    dt: float,
) -> float:
    """The force that appears as `apparent` at the end of a step.

    The slope of what appears over the force is between 1 - g and 1: with a g of less than a half
    Newton's steps close in on it from anywhere.
    """
    force = apparent + stress
    for _ in range(_ITERATIONS):
        half = 0.5 * part * (force - before)
        between = stress + half
        spread = _spread(between, part, stress_n, power, dt)
        value = force - half - between * spread ** (1.0 / (1.0 - power))
        slope = 1.0 - 0.5 * part * (1.0 + spread ** (power / (1.0 - power)))
        step = (value - apparent) / slope
        force -= step
        if abs(step) <= _CLOSE * max(abs(force), 1.0):
            break
    return force
