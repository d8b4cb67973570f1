"""A chip that reads no further than some level within its range: an edge at the top of loadings.

Of a load that rises and falls, a reading spends little time at its highest, and not at the same
pressure each time. Behind a clip it does: the histogram ends in a peak, as wide as the noise, with
less below it, at the same level loading after loading. Whether noise comes before the clip or
behind it does not matter. Evidence is gathered as in a sequential test (Wald 1945), never below
zero: how much likelier the level of a loading is behind a clip than without one.

What is at the edge is a lower bound from then on, as it is at the chip's own end.
"""

from __future__ import annotations

import math

import numpy as np

from devices.compiled import compiled
from service.estimation.records import Record, Records, record_type, records

ENOUGH = 11.0
"""Natural logarithm: after a healthy loading with a flat top the chance of as much is one in
60 000. A clip gathers it in six."""
SAME = 0.25
"""In units of the noise: scatter of the mean at a clip's edge from loading to loading."""
ELSEWHERE = 0.3
"""Probability density, per unit of the noise, of such a mean in a healthy tile, which is no top of
that edge if it is far away. In recorded walking it is 0.2 to 0.3."""
EDGE = 2.5
"""In units of the noise: what counts as at the edge, half of that as its middle; as much below it
again is the slope that leads to it."""
STEEP = 3.0
"""How many more readings there are in the middle of an edge than on the slope, which is as wide; at
the top of half a sine there are twice as many."""
ROUND = 1.5
"""A loading with a round top at the same level is so much evidence against a clip, and so is one
that ends below it ..."""
NEAR = 12.0
"""... by so little, in units of the noise: loads end there for themselves."""
OTHER = 0.06
"""While loadings stay at the edge equally long, within this part, they are one load again and
again, and say nothing: a plate that rolls over a foot at one speed."""
HOLE = 0.03
"""A loading says nothing if for this part of its stay, at one go, it was not read, and more than
one reading is missing: what is lost would make one load again and again look like loads that
differ."""
RECENT = 0.25
"""Weight of a new loading in what is usual."""
READINGS_MIN = 20
"""Of a loading, at the edge."""
OVER = 4.0
"""In units of the noise: what lies farther above the edge is no reading behind a clip ..."""
OVER_SHARE = 0.05
"""... except for so many outliers."""
BOUND = 3.0
"""In units of the noise, below the edge: from here on a reading may have been clipped."""
FOLLOW = 0.5
"""How much of the way to the mean of a loading the edge is moved."""
SMOOTH = 8.0
"""Readings over which the first loading's highest level is averaged."""

STATE = record_type(
    [
        ("inside", np.int64),  # is it loaded?
        ("smooth_kpa", np.float64),
        ("peak_kpa", np.float64),  # of this loading
        ("read_ns", np.int64),  # when it was read last
        ("hole_ns", np.int64),  # longest time without a reading of this loading
        ("at", np.int64),  # readings of this loading at the edge, ...
        ("stay_ns", np.int64),  # ... and how long it was there
        ("usual_ns", np.float64),  # stay of loadings lately, ...
        ("apart_ns", np.float64),  # ... and how far from it they are
        ("middle", np.int64),
        ("slope", np.int64),
        ("over", np.int64),
        ("at_kpa", np.float64),  # ... and the sum of these, relative to the edge
        ("edge_kpa", np.float64),  # NaN before the first loading
        ("evidence", np.float64),  # that it is one
        ("end_kpa", np.float64),  # of what can be told; infinite while there is no clip
    ]
)
"""What is remembered of each tile."""


def at_rest(tiles: int) -> Records:
    """Before the first reading."""
    return records(STATE, tiles, edge_kpa=np.nan, end_kpa=np.inf)


@compiled
def end_of_range(
    tile: Record,
    kpa: float,
    t_ns: int,
    baseline_kpa: float,
    unloaded_kpa: float,
    noise_kpa: float,
) -> float:
    """Above which pressure a reading may have been clipped; infinite where nothing shows it.

    Args:
        tile: state from its readings before; becomes that after this one.
        kpa: absolute; NaN where there is none.
        t_ns: when.
        baseline_kpa: absolute, unloaded.
        unloaded_kpa: so near the baseline no load is seen.
        noise_kpa: standard deviation of a reading.
    """
    above = kpa - baseline_kpa
    if not math.isnan(above):
        passed_ns, tile.read_ns = t_ns - tile.read_ns, t_ns
        if tile.inside == 0 and above > 2.0 * unloaded_kpa:
            tile.inside, tile.at, tile.middle, tile.slope, tile.over = 1, 0, 0, 0, 0
            tile.hole_ns, tile.stay_ns, tile.at_kpa = 0, 0, 0.0
            tile.smooth_kpa = tile.peak_kpa = kpa
        if tile.inside == 1:
            tile.hole_ns = max(tile.hole_ns, passed_ns)
            tile.smooth_kpa += (kpa - tile.smooth_kpa) / SMOOTH
            tile.peak_kpa = max(tile.peak_kpa, tile.smooth_kpa)
            off = kpa - tile.edge_kpa
            if off > OVER * noise_kpa:
                tile.over += 1
            elif off > -EDGE * noise_kpa:
                tile.at += 1
                tile.stay_ns += passed_ns
                tile.at_kpa += off
                if abs(off) < 0.5 * EDGE * noise_kpa:
                    tile.middle += 1
            elif off > -2.0 * EDGE * noise_kpa:
                tile.slope += 1
            if above < unloaded_kpa:
                _end_of_loading(tile, noise_kpa)
    end_kpa: float = tile.end_kpa
    return end_kpa


@compiled
def _end_of_loading(tile: Record, noise: float) -> None:
    tile.inside = 0
    if tile.peak_kpa < tile.edge_kpa - 2.0 * EDGE * noise:
        if tile.peak_kpa > tile.edge_kpa - NEAR * noise:
            tile.evidence = max(0.0, tile.evidence - ROUND)
        return  # a lighter one says nothing
    if tile.over > OVER_SHARE * tile.at or math.isnan(tile.edge_kpa):
        tile.edge_kpa, tile.evidence, tile.end_kpa = tile.peak_kpa, 0.0, math.inf
        tile.usual_ns = tile.apart_ns = 0.0
        return
    if tile.at < READINGS_MIN or tile.hole_ns > max(HOLE, 2.5 / tile.at) * tile.stay_ns:
        return
    if tile.middle < STEEP * tile.slope:
        tile.evidence = max(0.0, tile.evidence - ROUND)
        return
    off = tile.at_kpa / (tile.at * noise)
    if tile.usual_ns == 0.0:
        tile.usual_ns = tile.stay_ns
    tile.apart_ns += RECENT * (abs(tile.stay_ns - tile.usual_ns) - tile.apart_ns)
    tile.usual_ns += RECENT * (tile.stay_ns - tile.usual_ns)
    tile.edge_kpa += FOLLOW * off * noise
    likelier = -0.5 * (off / SAME) ** 2 - math.log(SAME * math.sqrt(2.0 * math.pi) * ELSEWHERE)
    tile.evidence = max(0.0, tile.evidence + likelier)
    if tile.evidence >= ENOUGH and tile.apart_ns > OTHER * tile.usual_ns:
        tile.end_kpa = tile.edge_kpa - BOUND * noise
