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

from devices.arrays import Floats
from devices.compiled import compiled
from service.estimation.effects import PARTS_MAX
from service.estimation.foot import UNSEEN_NS
from service.estimation.records import Record, Records, record_type, records

LAW = record_type(
    [
        ("part", np.float64, (PARTS_MAX,)),
        ("tau_s", np.float64, (PARTS_MAX,)),
        ("terms", np.int64),
    ]
)
"""Constants of a tile, as in `Rubber`, and how many of the terms there are."""
STATE = record_type(
    [
        ("force_n", np.float64),
        ("t_ns", np.int64),
        ("crept_n", np.float64, (PARTS_MAX,)),
        ("share", np.float64, (PARTS_MAX,)),  # of the force now; needed within a reading only
    ]
)
"""Of a tile: crept parts, and the force before (NaN: none)."""


def at_rest(tiles: int) -> Records:
    """Before the first reading."""
    return records(STATE, tiles, force_n=np.nan)


@dataclass(frozen=True)
class Rubber:
    """Parameters (tiles, terms): parts of the force that appear later, and after what time."""

    part: Floats
    tau_s: Floats

    def laws(self) -> Records:
        """The constants, tile by tile."""
        tiles, terms = self.part.shape
        made = records(LAW, tiles, terms=terms)
        made["part"][:, :terms], made["tau_s"][:, :terms] = self.part, self.tau_s
        return made


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
        borne_n: force under which the dome creeps, whatever the apparent one says; NaN: what that
            says.
        away_n: force that may have been borne while there was no reading for more than
            `UNSEEN_NS`: it or nothing was, whichever is farther from the straight line; NaN: the
            straight line.
    """
    if not math.isfinite(apparent_n):
        return math.nan
    if math.isnan(state.force_n):  # the first reading: at rest without a force
        state.force_n, state.t_ns = 0.0, t_ns
    before, passed_ns = state.force_n, t_ns - state.t_ns
    was_away = away_n > 0.0 and passed_ns > UNSEEN_NS
    meanwhile = away_n if before + apparent_n < away_n else 0.0
    left, known = 1.0, apparent_n
    for m in range(law.terms):
        decay, of_before, of_now = crept_parts(max(0.0, passed_ns * 1e-9 / law.tau_s[m]))
        if was_away:  # until just now
            carried, share = decay * state.crept_n[m] + (1.0 - decay) * meanwhile, 0.0
        else:
            carried, share = decay * state.crept_n[m] + of_before * before, of_now
        left -= law.part[m] * (1.0 - share)
        known -= law.part[m] * carried
        state.crept_n[m], state.share[m] = carried, share
    found: float = known / left
    now = found if math.isnan(borne_n) else borne_n
    for m in range(law.terms):
        state.crept_n[m] += state.share[m] * now
    state.force_n, state.t_ns = now, t_ns
    return found


@compiled
def crept_parts(h: float) -> tuple[float, float, float]:
    """Weights of the crept part, the force before and the force now, after `h` time constants."""
    decay = math.exp(-h)
    mean = -math.expm1(-h) / h if h > 0.0 else 1.0
    return decay, mean - decay, 1.0 - mean
