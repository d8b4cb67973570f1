"""`hysteresis`: the rubber's loop, which does not depend on speed (hardware.md 9).

The force that the bubble feels lags behind F by the sum of a few play operators::

    felt = F + sum w (y - F),  y kept within F -+ min(r, OPENS F)

each a part w of the force with a play of half width r; near zero load the branches meet. Solved for
F at every sample. A play operator moves with every reversal, and so with noise: that is why this
comes after `denoise`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.estimation.compiled import compiled

Floats = npt.NDArray[np.float64]

WIDTHS_N = np.array([0.6, 1.5, 4.0])
"""Half widths of the plays; their parts are what is fitted."""
OPENS = 0.4
_ITERATIONS = 60
_CLOSE_N = 1e-13


@dataclass(frozen=True)
class Hysteresis:
    """Parts (tiles, plays), each play of half width `WIDTHS_N`; in sum below 1."""

    part: Floats

    def at_rest(self) -> Floats:
        """State before the first reading: plays (tiles, plays) at zero load."""
        return np.zeros(self.part.shape)

    def unfelt(self, felt_n: Floats, plays_n: Floats) -> tuple[Floats, Floats]:
        """Forces of which these are felt, and the plays after them.

        Args:
            felt_n: (n, tiles); NaN stays NaN and changes nothing after it.
            plays_n: state from the readings before.
        """
        out = np.empty_like(felt_n)
        plays_n = plays_n.copy()
        _unfelt(np.ascontiguousarray(felt_n), self.part, WIDTHS_N, plays_n, out)
        return out, plays_n


@compiled
def played(force: float, width: float, before: float) -> float:
    """A play after a force; it lags behind by no more than its width allows."""
    half = min(width, OPENS * max(force, 0.0))
    return min(max(before, force - half), force + half)


@compiled
def _unfelt(
    felt_n: Floats,
    part: Floats,
    widths: Floats,
    plays: Floats,
    out: Floats,
) -> None:
    n, tiles = felt_n.shape
    for j in range(tiles):
        force = 0.0
        for i in range(n):
            felt = felt_n[i, j]
            if math.isnan(felt):
                out[i, j] = math.nan
                continue
            # Contracts by the sum of the parts, which is well below one.
            force = felt
            for _ in range(_ITERATIONS):
                lag = 0.0
                for m in range(len(widths)):
                    lag += part[j, m] * (played(force, widths[m], plays[j, m]) - force)
                closer = felt - lag
                done = abs(closer - force) <= _CLOSE_N * (1.0 + abs(felt))
                force = closer
                if done:
                    break
            for m in range(len(widths)):
                plays[j, m] = played(force, widths[m], plays[j, m])
            out[i, j] = force
