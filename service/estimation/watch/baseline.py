"""A baseline that is lost: a dome that has leaked, or one that has moved and nobody knows why.

No load makes a dome read less than it does without one. If it stays below its baseline, by more
than temperature, surroundings and the gas of a released dome explain, then gas is missing, or it is
colder than its chip says. How much less it has read at most is how wrong it may be.

A leak so fast that air comes back within a moment shows as well: what leaks out under load has to
come in again, so it reads too little afterwards as much as it has read too much. A sealed dome
hardly reads too little at all.

A tile that reads too much for good cannot be told from one that bears a load.
"""

from __future__ import annotations

import math

import numpy as np

from devices.compiled import compiled
from service.estimation.records import Record, Records, record_type, records

LOST_KPA = 0.4
"""Four fifths of a newton; creep and hysteresis leave half of that of a fast release."""
SIGMAS = 5.0
"""So many standard uncertainties a baseline may be off that is known to be uncertain ..."""
WARMTH = 1.5
"""... and so much of what a kelvin does to it: the wall gives way, and chip and gas differ."""
SMOOTH_S = 0.05
HELD_NS = 350_000_000
"""A released dome's gas is back at its wall's temperature: five times 60 ms, and the smoothing."""
EVEN = 0.08
"""This part of what was read too much has to be read too little, of a tile whose gas is corrected:
the longer a leak takes, the more comes back slowly enough to be read. Of 30 ms it is a tenth."""
EVEN_WITHOUT_GAS = 0.35
"""The same of one whose gas is not corrected: it is cold after a release, in a fast hop a fifth."""
EVEN_MIN_KPA_S = 0.3
"""Less than this is no evidence."""
FORGET_S = 10.0
PAUSE_S = 0.5
"""Of a longer gap in the readings nothing is known."""
NEVER_NS = -(1 << 62)

STATE = record_type(
    [
        ("kpa", np.float64),  # smoothed, above the baseline; NaN before the first
        ("t_ns", np.int64),
        ("below_ns", np.int64),  # since when it has been below
        ("deepest_kpa", np.float64),
        ("highest_kpa", np.float64),
        ("more_kpa_s", np.float64),
        ("less_kpa_s", np.float64),
        ("lost_kpa", np.float64),
    ]
)
"""What is remembered of each tile."""


def at_rest(tiles: int) -> Records:
    """Before the first reading."""
    return records(STATE, tiles, kpa=np.nan, below_ns=NEVER_NS)


@compiled
def lost(
    tile: Record, even: float, gauge_kpa: float, variance: float, warmed_kpa: float, t_ns: int
) -> float:
    """How wrong a tile's baseline may be, from when it shows until the next tare; 0: nothing shows.

    Args:
        tile: state from its readings before; becomes that after this one.
        even: `EVEN` or `EVEN_WITHOUT_GAS`.
        gauge_kpa: above the baseline, with all that models correct; NaN where unknown.
        variance: of the baseline, as far as it is known to be uncertain.
        warmed_kpa: what warmth that no model corrects has moved it by.
        t_ns: instant.
    """
    if not math.isnan(gauge_kpa):
        step_s = max(0.0, (t_ns - tile.t_ns) * 1e-9)
        if math.isnan(tile.kpa) or step_s > PAUSE_S:
            tile.kpa, tile.below_ns, step_s = gauge_kpa, NEVER_NS, 0.0
        # The watch filters by implicit steps: stable however long, and without an exponential.
        tile.kpa += step_s / (SMOOTH_S + step_s) * (gauge_kpa - tile.kpa)
        tile.t_ns = t_ns
        bound = LOST_KPA + SIGMAS * math.sqrt(variance) + WARMTH * abs(warmed_kpa)
        kept = FORGET_S / (FORGET_S + step_s)
        tile.more_kpa_s *= kept
        tile.less_kpa_s *= kept
        if tile.kpa >= -bound:
            tile.below_ns = NEVER_NS
            if tile.kpa > bound:
                tile.more_kpa_s += step_s * tile.kpa
                tile.highest_kpa = max(tile.highest_kpa, tile.kpa)
        else:
            tile.deepest_kpa = max(tile.deepest_kpa, -tile.kpa)
            if tile.kpa < -bound - tile.lost_kpa:  # a dip, beyond what has moved for good
                tile.less_kpa_s -= step_s * tile.kpa
            if tile.below_ns == NEVER_NS:
                tile.below_ns = tile.t_ns
            if tile.t_ns - tile.below_ns > HELD_NS:
                tile.lost_kpa = max(tile.lost_kpa, -tile.kpa)
            least = max(EVEN_MIN_KPA_S, even * tile.more_kpa_s)
            if tile.less_kpa_s > least and tile.highest_kpa > 0.0:
                # Then nothing of it is force.
                tile.lost_kpa = max(tile.lost_kpa, tile.highest_kpa, tile.deepest_kpa)
    lost_kpa: float = tile.lost_kpa
    return lost_kpa
