"""Detector of a chip that clips: readings that go no higher than an edge within the chip's range.

A load that rises and falls spends little time at its top, and its tops differ. Behind a clip, the
histogram of a loading ends in a peak that is as wide as the noise and has less below it, and this
edge is at one pressure in loadings that differ. Whether noise comes before the clip or behind it
does not matter.

The evidence is that of a sequential test (Wald 1945), never below zero: the log likelihood ratio of
the edge's place with a clip and without. Equal loads have equal tops, so each load counts for a
clip once, and evidence fades while loads repeat: a scene that repeats gathers no more however long
it runs. A load is identified by the integral of the tile's pressure, up to just below the edge, and
by the pressure of the other tiles meanwhile. A loading begins and ends with two readings each, so
that an outlier does not divide it.

A reading at the edge is a lower bound from then on, as one at the chip's own end.
"""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np

from devices.arrays import Floats
from devices.jit import jit_cached
from service.estimation.records import KernelRecord

ENOUGH = 11.0
"""Evidence of a clip, natural logarithm: after a healthy loading with a flat top the chance of as
much is one in 60 000. A clip gathers it in six loadings that differ."""
SAME = 0.1
"""In units of the noise: scatter of the mean at a clip's edge from loading to loading, besides that
of the noise itself."""
ELSEWHERE = 0.3
"""Probability density, per unit of the noise, of such a mean in a healthy tile, which is no top of
that edge if it is far away. In recorded walking it is 0.2 to 0.3."""
EDGE = 2.5
"""Half width of the edge, in units of the noise; its middle has half of that. The slope that leads
to the edge is the range of this width below it."""
STEEP = 3.0
"""Least ratio of readings in the middle of an edge to readings on the slope, which is as wide; at
the top of half a sine the ratio is two."""
ROUND = 1.5
"""Evidence against a clip, from a loading with a round top at the same level, or with its top below
it by less than `NEAR`."""
NEAR = 12.0
"""Distance below the edge, in units of the noise, within which a loading ended by itself."""
LOADS = 16
"""Number of remembered loads; the next one replaces the oldest."""
APART = 0.008
"""Relative difference of one of two loads' measures from which on they differ, if it also exceeds
`APART_SIGMAS`."""
APART_SIGMAS = 4.0
"""That difference in standard deviations of the measure."""
BELOW = 3.0
"""Distance below the edge, in units of the noise, at which the integrated pressure is limited:
behind a clip the rest is noise."""
FADING = 0.98
"""Factor of the evidence after a loading whose load has counted before."""
HOLE = 0.03
"""A loading with a longer hole than this part of its stay at the edge, and than one reading, does
not count: without its missing frames a load would differ from itself."""
READINGS_MIN = 20
"""Least number of a loading's readings at the edge, for it to count."""
OVER = 4.0
"""Distance above the edge, in units of the noise, beyond which a reading is not behind a clip."""
OVER_SHARE = 0.05
"""Share of such readings that are taken for outliers, relative to readings at the edge."""
BOUND = 3.0
"""Distance below the edge, in units of the noise, from which on a reading may have been clipped."""
FOLLOW = 0.5
"""Part of the way to the mean of a loading by which the edge is moved."""
SMOOTH = 8.0
"""Readings over which the first loading's highest level is averaged."""


class ClippingState(KernelRecord):
    """State of one tile's detector."""

    inside: int  # 1: it is loaded
    turning: int  # readings in a row that say otherwise
    smooth_kpa: float
    peak_kpa: float  # of this loading
    read_ns: int  # when it was read last, ...
    felt_kpa: float  # ... how far above the baseline, at most `most_kpa`, ...
    others_kpa: float  # ... and how far the other tiles were, in all
    most_kpa: float = np.inf  # infinite before the first loading
    readings: int  # of this loading
    hole_ns: int  # longest time without a reading
    load_kpa_s: float  # integral of the pressure, ...
    load_variance: float  # ... its variance, of noise and of holes, ...
    others_kpa2_s: float  # ... and integral of the product with that on the others
    at: int  # readings at the edge, ...
    stay_ns: int  # ... how long it was there, ...
    at_kpa: float  # ... and the sum of these, relative to the edge
    middle: int
    slope: int
    over: int
    edge_kpa: float = np.nan  # NaN before the first loading
    loads: int  # how many have counted, ...
    loads_kpa_s: Annotated[Floats, (LOADS,)]  # ... the integrals of the last ones, ...
    loads_others_kpa: Annotated[Floats, (LOADS,)]  # ... and what the others bore
    evidence: float  # that the edge is a clip
    end_kpa: float = np.inf  # of what can be told; infinite while there is no clip


@jit_cached
def update_clipping_limit_kpa(
    tile: ClippingState,
    kpa: float,
    t_ns: int,
    baseline_kpa: float,
    unloaded_band_kpa: float,
    noise_kpa: float,
    variance_inflation: float,
    others_kpa: float,
) -> float:
    """Update the state; return the pressure from which readings may be clipped, or infinity.

    Args:
        tile: state from its readings before; becomes that after this one.
        kpa: absolute pressure; NaN without a reading.
        t_ns: its instant.
        baseline_kpa: absolute, unloaded.
        unloaded_band_kpa: distance from the baseline within which no load is seen.
        noise_kpa: standard deviation of a reading.
        variance_inflation: variance of a mean of many readings, relative to that of white noise.
        others_kpa: sum of the other tiles' pressures above their baselines; NaN if one is missing:
            the last known sum is used.
    """
    above = kpa - baseline_kpa
    if not math.isnan(above):
        if math.isnan(others_kpa):
            others_kpa = tile.others_kpa
        is_unloaded = above < unloaded_band_kpa
        # A single outlier does not part a loading in two.
        turns = is_unloaded if tile.inside == 1 else above > 2.0 * unloaded_band_kpa
        tile.turning = tile.turning + 1 if turns else 0
        felt_kpa = min(above, tile.most_kpa)
        if tile.inside == 0 and is_unloaded:
            _begin(tile, kpa)
        else:
            passed_ns = t_ns - tile.read_ns
            _integrate(tile, 1e-9 * passed_ns, felt_kpa, others_kpa, noise_kpa)
            _count(tile, kpa, passed_ns, noise_kpa)
        tile.read_ns, tile.felt_kpa, tile.others_kpa = t_ns, felt_kpa, others_kpa
        if tile.turning == 2:
            tile.inside, tile.turning = 1 - tile.inside, 0
            if tile.inside == 0:
                _end_of_loading(tile, baseline_kpa, noise_kpa, math.sqrt(variance_inflation))
                _begin(tile, kpa)
    return tile.end_kpa


@jit_cached
def _begin(tile: ClippingState, kpa: float) -> None:
    """Reset the measures for a new loading."""
    tile.smooth_kpa = tile.peak_kpa = kpa
    tile.readings = tile.at = tile.middle = tile.slope = tile.over = 0
    tile.hole_ns = tile.stay_ns = 0
    tile.load_kpa_s = tile.load_variance = tile.others_kpa2_s = tile.at_kpa = 0.0


@jit_cached
def _integrate(
    tile: ClippingState, passed_s: float, felt_kpa: float, others_kpa: float, noise_kpa: float
) -> None:
    """Add the time since the reading before to the measures of the load."""
    moved_kpa = felt_kpa - tile.felt_kpa
    product_kpa2 = felt_kpa * others_kpa + tile.felt_kpa * tile.others_kpa
    tile.load_kpa_s += passed_s * (felt_kpa - 0.5 * moved_kpa)
    tile.others_kpa2_s += 0.5 * passed_s * product_kpa2
    # Whenever it moved between the two readings: evenly distributed.
    variance = moved_kpa**2 / 12.0 + (noise_kpa**2 if felt_kpa < tile.most_kpa else 0.0)
    tile.load_variance += passed_s**2 * variance


@jit_cached
def _count(tile: ClippingState, kpa: float, passed_ns: int, noise_kpa: float) -> None:
    """Count a reading: at the edge, on the slope below it, or over it."""
    tile.readings += 1
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


@jit_cached
def _end_of_loading(tile: ClippingState, baseline_kpa: float, noise: float, lasts: float) -> None:
    """Update edge and evidence from an ended loading.

    `lasts` is the standard deviation of means, relative to that of white noise.
    """
    if tile.peak_kpa < tile.edge_kpa - 2.0 * EDGE * noise:
        if tile.peak_kpa > tile.edge_kpa - NEAR * noise:
            tile.evidence = max(0.0, tile.evidence - ROUND)
        return  # a lighter one says nothing
    if tile.over > OVER_SHARE * tile.at or math.isnan(tile.edge_kpa):
        tile.edge_kpa, tile.evidence, tile.end_kpa = tile.peak_kpa, 0.0, math.inf
        # The edge moves, this does not: loads would differ from themselves.
        tile.most_kpa, tile.loads = tile.edge_kpa - BELOW * noise - baseline_kpa, 0
        return
    if tile.at < READINGS_MIN or tile.hole_ns > max(HOLE, 2.5 / tile.at) * tile.stay_ns:
        return
    if tile.middle < STEEP * tile.slope:
        tile.evidence = max(0.0, tile.evidence - ROUND)
        return
    off = tile.at_kpa / (tile.at * noise)
    tile.edge_kpa += FOLLOW * off * noise
    same = math.sqrt(SAME**2 + lasts**2 / tile.at)
    likelier = -0.5 * (off / same) ** 2 - math.log(same * math.sqrt(2.0 * math.pi) * ELSEWHERE)
    if likelier > 0.0 and not _is_new(tile, noise * lasts, lasts):
        tile.evidence *= FADING
        return
    tile.evidence = max(0.0, tile.evidence + likelier)
    if tile.evidence >= ENOUGH:
        tile.end_kpa = tile.edge_kpa - BOUND * noise


@jit_cached
def _is_new(tile: ClippingState, noise_kpa: float, lasts: float) -> bool:
    """Remember the load of this loading, unless it is like one that has counted."""
    others_kpa = tile.others_kpa2_s / tile.load_kpa_s
    sigma_kpa_s = lasts * math.sqrt(tile.load_variance)
    apart_kpa_s = max(APART_SIGMAS * sigma_kpa_s, APART * tile.load_kpa_s)
    sigma_kpa = 2.0 * noise_kpa / math.sqrt(tile.readings)
    apart_kpa = max(APART_SIGMAS * sigma_kpa, APART * abs(others_kpa))
    for k in range(min(tile.loads, LOADS)):
        if (
            abs(tile.load_kpa_s - tile.loads_kpa_s[k]) < apart_kpa_s
            and abs(others_kpa - tile.loads_others_kpa[k]) < apart_kpa
        ):
            return False
    tile.loads_kpa_s[tile.loads % LOADS] = tile.load_kpa_s
    tile.loads_others_kpa[tile.loads % LOADS] = others_kpa
    tile.loads += 1
    return True
