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

WIDTHS_N = np.array([0.6, 1.5, 4.0])
"""Half widths of the plays; their parts are what is fitted."""
OPENS = 0.4
_ITERATIONS = 100  # a bound; see `_inverted`
_CLOSE = 1e-14
"""Relative; a smaller step changes nothing any more."""
_NONE = np.empty((0, 0))


@dataclass(frozen=True)
class Hysteresis:
    """Parts (tiles, plays), each play of half width `WIDTHS_N`; in sum below 1."""

    part: Floats

    def at_rest(self) -> Floats:
        """State before the first reading: plays (tiles, plays) at zero load."""
        return np.zeros(self.part.shape)

    def compensated(
        self, apparent_n: Floats, plays_n: Floats, *, borne_n: Floats | None = None
    ) -> tuple[Floats, Floats]:
        """Forces that appear as these, and the plays after them.

        Args:
            apparent_n: (n, tiles); NaN stays NaN and changes nothing after it.
            plays_n: state from the readings before.
            borne_n: (n, tiles), forces that move the plays, whatever the apparent ones say; NaN:
                what they say.
        """
        borne_n = _NONE if borne_n is None else np.ascontiguousarray(borne_n)
        out = np.empty_like(apparent_n)
        plays_n = plays_n.copy()
        _compensate(np.ascontiguousarray(apparent_n), self.part, WIDTHS_N, borne_n, plays_n, out)
        return out, plays_n


@compiled
def played(force: float, width: float, before: float) -> float:
    """A play after a force; it lags behind by no more than its width allows."""
    half = min(width, OPENS * max(force, 0.0))
    return min(max(before, force - half), force + half)


@compiled
def _inverted(apparent: float, part: Floats, widths: Floats, plays: Floats) -> float:
    """The force that these plays show as `apparent`.

    It is piecewise linear over the force and rises with it: Newton's steps end on the right piece
    after a few, and halving an interval around the force keeps them from going in circles.
    """
    if apparent <= 0.0:  # all plays are closed
        return apparent
    low, high, force = 0.0, math.inf, apparent
    for _ in range(_ITERATIONS):
        value, slope = force, 1.0
        for m in range(len(widths)):
            value += part[m] * (played(force, widths[m], plays[m]) - force)
            slope += part[m] * _play_slope(force, widths[m], plays[m])
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


@compiled
def _compensate(
    apparent_n: Floats,
    part: Floats,
    widths: Floats,
    borne: Floats,
    plays: Floats,
    out: Floats,
) -> None:
    n, tiles = apparent_n.shape
    for j in range(tiles):
        for i in range(n):
            if not math.isfinite(apparent_n[i, j]):
                out[i, j] = math.nan
                continue
            out[i, j] = force = _inverted(apparent_n[i, j], part[j], widths, plays[j])
            if len(borne) > 0 and not math.isnan(borne[i, j]):
                force = borne[i, j]
            for m in range(len(widths)):
                plays[j, m] = played(force, widths[m], plays[j, m])
