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

from devices.arrays import Arrays, Floats, Times
from devices.compiled import compiled
from service.estimation.foot.contact import UNSEEN_NS

STROKE_N_PER_S = 10.0
"""R: about that of a bench's slow stroke, so that what is fitted is what the stroke shows."""
_ITERATIONS = 50  # a bound; three to five are the rule
_CLOSE = 1e-14  # of the force, or of a newton
_NONE = np.empty((0, 0))


@dataclass(frozen=True)
class FlowState(Arrays):
    """Of every tile: what the branch bears, and the force before (NaN: none)."""

    stress_n: Floats
    force_n: Floats
    t_ns: Times


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

    def at_rest(self) -> FlowState:
        """Before the first reading."""
        tiles = len(self.part)
        return FlowState(np.zeros(tiles), np.full(tiles, np.nan), np.zeros(tiles, dtype=np.int64))

    def compensated(
        self,
        apparent_n: Floats,
        t_ns: Times,
        state: FlowState,
        *,
        borne_n: Floats | None = None,
        away_n: Floats | None = None,
    ) -> tuple[Floats, FlowState]:
        """Forces that appear as these.

        Args:
            apparent_n: (n, tiles); NaN stays NaN and changes nothing after it.
            t_ns: instants (n, tiles).
            state: from the readings before.
            borne_n: (n, tiles), forces under which the branch flows, whatever the apparent ones
                say; NaN: what they say.
            away_n: (tiles,), force that may have been borne while there was no reading for more
                than `UNSEEN_NS`: it or nothing was, whichever is farther from the straight line;
                None: the straight line.
        """
        out = np.empty_like(apparent_n)
        after = state.copy()
        _compensate(
            np.ascontiguousarray(apparent_n),
            np.ascontiguousarray(t_ns),
            self.part,
            self.stress_n,
            self.power,
            _NONE if borne_n is None else np.ascontiguousarray(borne_n),
            np.full(len(self.part), math.nan) if away_n is None else away_n,
            after.stress_n,
            after.force_n,
            after.t_ns,
            out,
        )
        return out, after


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


@compiled
def _compensate(
    apparent_n: Floats,
    t_ns: Times,
    part: Floats,
    stress_n: Floats,
    power: Floats,
    borne: Floats,
    away: Floats,
    stress: Floats,
    force: Floats,
    last_ns: Times,
    out: Floats,
) -> None:
    n, tiles = apparent_n.shape
    for j in range(tiles):
        before, before_ns, s = force[j], last_ns[j], stress[j]
        law = (part[j], stress_n[j], power[j])
        for i in range(n):
            apparent = apparent_n[i, j]
            if not math.isfinite(apparent):
                out[i, j] = math.nan
                continue
            if math.isnan(before):  # the first reading: at rest without a force
                before, before_ns = 0.0, t_ns[i, j]
            dt = max(0.0, (t_ns[i, j] - before_ns) * 1e-9)
            if away[j] > 0.0 and t_ns[i, j] - before_ns > UNSEEN_NS:  # until just now
                before = away[j] if before + apparent < away[j] else 0.0
                s, dt = 0.0, 0.0
            out[i, j] = now = _inverted(apparent, before, s, *law, dt)
            if len(borne) > 0 and not math.isnan(borne[i, j]):
                now = borne[i, j]
            s = flowed(s, *law, now - before, dt)
            before, before_ns = now, t_ns[i, j]
        stress[j], force[j], last_ns[j] = s, before, before_ns
