"""`rubber`: creep of the dome, whose rubber gives way to a force within seconds (hardware.md 9).

Of a force F a part appears in the bubble at once and the rest later; two Prony terms with the parts
g and times tau::

    apparent = F - sum g (F - z),  tau dz/dt = F - z

Inverted for F with F linear between samples, which is exact and stable for any step. A force that
has lasted appears whole, so the static curve is untouched.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from devices.arrays import Arrays, Floats, Times
from devices.compiled import compiled
from service.estimation.foot.contact import UNSEEN_NS

_NONE = np.empty((0, 0))


@dataclass(frozen=True)
class RubberState(Arrays):
    """Of every tile: crept parts (tiles, terms), and the force before (NaN: none)."""

    crept_n: Floats
    force_n: Floats
    t_ns: Times


@dataclass(frozen=True)
class Rubber:
    """Parameters (tiles, terms): parts of the force that appear later, and after what time."""

    part: Floats
    tau_s: Floats

    def at_rest(self) -> RubberState:
        """Before the first reading."""
        tiles = len(self.part)
        return RubberState(
            np.zeros(self.part.shape), np.full(tiles, np.nan), np.zeros(tiles, dtype=np.int64)
        )

    def compensated(
        self,
        apparent_n: Floats,
        t_ns: Times,
        state: RubberState,
        *,
        borne_n: Floats | None = None,
        away_n: Floats | None = None,
    ) -> tuple[Floats, RubberState]:
        """Forces that appear as these.

        Args:
            apparent_n: (n, tiles); NaN stays NaN and changes nothing after it.
            t_ns: instants (n, tiles).
            state: from the readings before.
            borne_n: (n, tiles), forces under which the dome creeps, whatever the apparent ones
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
            self.tau_s,
            _NONE if borne_n is None else np.ascontiguousarray(borne_n),
            np.full(len(self.part), math.nan) if away_n is None else away_n,
            after.crept_n,
            after.force_n,
            after.t_ns,
            out,
        )
        return out, after


@compiled
def crept_parts(h: float) -> tuple[float, float, float]:
    """Weights of the crept part, the force before and the force now, after `h` time constants."""
    decay = math.exp(-h)
    mean = -math.expm1(-h) / h if h > 0.0 else 1.0
    return decay, mean - decay, 1.0 - mean


@compiled
def _compensate(
    apparent_n: Floats,
    t_ns: Times,
    part: Floats,
    tau_s: Floats,
    borne: Floats,
    away: Floats,
    crept: Floats,
    force: Floats,
    last_ns: Times,
    out: Floats,
) -> None:
    n, tiles = apparent_n.shape
    terms = part.shape[1]
    carried = np.empty(terms)
    share = np.empty(terms)
    for j in range(tiles):
        before, before_ns = force[j], last_ns[j]
        for i in range(n):
            apparent = apparent_n[i, j]
            if not math.isfinite(apparent):
                out[i, j] = math.nan
                continue
            if math.isnan(before):  # the first reading: at rest without a force
                before, before_ns = 0.0, t_ns[i, j]
            was_away = away[j] > 0.0 and t_ns[i, j] - before_ns > UNSEEN_NS
            meanwhile = away[j] if before + apparent < away[j] else 0.0
            left, known = 1.0, apparent
            for m in range(terms):
                h = max(0.0, (t_ns[i, j] - before_ns) * 1e-9 / tau_s[j, m])
                decay, of_before, of_now = crept_parts(h)
                if was_away:  # until just now
                    carried[m], share[m] = decay * crept[j, m] + (1.0 - decay) * meanwhile, 0.0
                else:
                    carried[m], share[m] = decay * crept[j, m] + of_before * before, of_now
                left -= part[j, m] * (1.0 - share[m])
                known -= part[j, m] * carried[m]
            out[i, j] = now = known / left
            if len(borne) > 0 and not math.isnan(borne[i, j]):
                now = borne[i, j]
            for m in range(terms):
                crept[j, m] = carried[m] + share[m] * now
            before, before_ns = now, t_ns[i, j]
        force[j], last_ns[j] = before, before_ns
