"""`hysteresis`: the rubber's loop, which does not depend on speed (hardware.md 9).

The force that appears in the bubble lags behind F by the sum of a few play operators::

    apparent = F + sum w (y - F),  y kept within F -+ min(r, OPENS F)

each a part w of the force with a play of half width r; near zero load the branches meet. Solved for
F at every sample. A play operator moves with every reversal, and so with noise: that is why this
comes after `denoise`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from devices.arrays import Floats
from devices.compiled import compiled
from service.estimation.records import Record, Records, record_type, records

WIDTHS_N = np.array([0.6, 1.5, 4.0])
"""Half widths of the plays; their parts are what is fitted."""
OPENS = 0.4
_ITERATIONS = 100  # a bound; see `_inverted`
_CLOSE = 1e-14
"""Relative; a smaller step changes nothing any more."""
PLAYS = len(WIDTHS_N)
LAW = record_type([("part", np.float64, (PLAYS,))])
"""Constants of a tile, as in `Hysteresis`."""
STATE = record_type([("plays_n", np.float64, (PLAYS,))])
"""Of a tile: where its plays are."""


def at_rest(tiles: int) -> Records:
    """Before the first reading."""
    return records(STATE, tiles)


@dataclass(frozen=True)
class Hysteresis:
    """Parts (tiles, plays), each play of half width `WIDTHS_N`; in sum below 1."""

    part: Floats

    def laws(self) -> Records:
        """The constants, tile by tile."""
        return records(LAW, len(self.part), part=self.part)


@compiled
def compensated(law: Record, state: Record, apparent_n: float, borne_n: float) -> float:
    """Force that appears as this; NaN stays NaN and changes nothing after it.

    Args:
        law: constants of the tile.
        state: its plays before; becomes those after this force.
        apparent_n: force that appears.
        borne_n: force that moves the plays, whatever the apparent one says; NaN: what that says.
    """
    if not math.isfinite(apparent_n):
        return math.nan
    found: float = _inverted(apparent_n, law.part, state.plays_n)
    force = found if math.isnan(borne_n) else borne_n
    for m in range(PLAYS):
        state.plays_n[m] = played(force, WIDTHS_N[m], state.plays_n[m])
    return found


@compiled
def played(force: float, width: float, before: float) -> float:
    """A play after a force; it lags behind by no more than its width allows."""
    half = min(width, OPENS * max(force, 0.0))
    return min(max(before, force - half), force + half)


@compiled
def _inverted(apparent: float, part: Floats, plays: Floats) -> float:
    """The force that these plays show as `apparent`.

    It is piecewise linear over the force and rises with it: Newton's steps end on the right piece
    after a few, and halving an interval around the force keeps them from going in circles.
    """
    if apparent <= 0.0:  # all plays are closed
        return apparent
    low, high, force = 0.0, math.inf, apparent
    for _ in range(_ITERATIONS):
        value, slope = force, 1.0
        for m in range(PLAYS):
            value += part[m] * (played(force, WIDTHS_N[m], plays[m]) - force)
            slope += part[m] * _play_slope(force, WIDTHS_N[m], plays[m])
        if value > apparent:
            high = force
        else:
            low = force
        better = force - (value - apparent) / slope
        if abs(better - force) <= _CLOSE * force:
            return better
        force = better if low < better < high else 0.5 * (low + min(high, 2.0 * force))
    return force


@compiled
def _play_slope(force: float, width: float, before: float) -> float:
    """How a play's distance from the force changes with the force."""
    half = min(width, OPENS * force)
    if force - half <= before <= force + half:
        return -1.0
    opening = OPENS if half < width else 0.0
    return opening if before > force else -opening
