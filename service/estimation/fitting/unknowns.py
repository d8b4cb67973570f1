"""Unknowns of a tile's fit, with their priors and bounds.

Priors separate effects that look alike, such as a cooling gas and a fast creep: every unknown has a
likely value with a standard deviation. Informative readings outweigh the prior; without them
the prior is the result, with its uncertainty.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from devices.arrays import Floats
from service.estimation.effects import FLOW_FRACTION_MAX, FLOW_STRESS_MIN_N
from service.estimation.fitting.rig.loading import LoadingPoints
from service.estimation.models.hysteresis import WIDTHS_N

_NO_LIMIT = 1e3  # newtons: far beyond any coefficient of a curve of 30 N
TERMS_MAX = 3  # of the creep
_CREEP_S = (0.01, 10.0)
"""Range of time constants: a foot's loads change within some ten milliseconds, and no rig holds a
load for long."""
_STEPS_MIN = 3.0  # readings within the shortest time of a creep


SAMPLE_DELAY_SIGMA_S = 0.00025
"""Prior standard deviation of a tile's sample delay: it samples in the first quarter of a
conversion of 1.6 ms (DS table 7), by assumption."""
_LATE_MOST = 2.4  # bound of the delay, in standard deviations


@dataclass(frozen=True)
class FittedEffects:
    """Effects that are fitted beside the curve.

    Attributes:
        late_s: prior of the tile's sample delay and its standard deviation; None: not fitted.
        gas: heat of the gas.
        terms: number of terms of the creep.
        hysteresis: loop.
        flow: viscous branch of the loop.
    """

    late_s: tuple[float, float] | None = (0.0, SAMPLE_DELAY_SIGMA_S)
    gas: bool = True
    terms: int = 2
    hysteresis: bool = True
    flow: bool = True


@dataclass(frozen=True)
class PriorGroup:
    """Unknowns of one name: prior values, their standard deviation, and bounds."""

    name: str
    prior: tuple[float, ...]
    prior_sigma: float
    lower: tuple[float, ...]
    upper: tuple[float, ...]


# Gamma of air is 1.40; a single time constant for a sphere's many lowers it (hardware.md 9).
# Bubbles cool within 5 to 60 ms.
_GAS = (
    PriorGroup("gamma", (1.25,), 0.1, (1.001,), (1.4,)),
    PriorGroup("ln_tau", (np.log(0.015),), 0.8, (np.log(0.0015),), (np.log(0.135),)),
)
_PART = (0.03, 0.05, 0.4)  # of a term: prior, standard deviation, bound
_LOOP = (0.05, 0.1, 0.3)  # of a play, likewise
# Loops are 1 to 5 % of full scale from branch to branch, any part of it viscous (hardware.md 9).
_FLOW = (
    PriorGroup("flow_part", (0.05,), 0.05, (0.0,), (FLOW_FRACTION_MAX,)),
    PriorGroup(
        "ln_flow_n", (np.log(0.2),), 1.0, (np.log(2.0 * FLOW_STRESS_MIN_N),), (np.log(2.0),)
    ),
    # Bergstrom and Boyce (1998) found about 4, in one rubber.
    PriorGroup("flow_power", (4.0,), 1.0, (2.0,), (8.0,)),
)


def _make_creep_unknowns(terms: int, creep_range_s: tuple[float, float]) -> tuple[PriorGroup, ...]:
    """Make the unknowns of creep: each term has its share of the time range, and half the next."""
    least, most = np.log(creep_range_s)
    share = (most - least) / terms
    centre = least + share * (np.arange(terms) + 0.5)
    likely, within, greatest = _PART
    return (
        PriorGroup("part", (likely,) * terms, within, (0.0,) * terms, (greatest,) * terms),
        PriorGroup(
            "ln_creep",
            tuple(centre.tolist()),
            share / 2.0,
            tuple(np.maximum(centre - share, least).tolist()),
            tuple(np.minimum(centre + share, most).tolist()),
        ),
    )


def list_unknowns(
    parts: FittedEffects, initial_curve: Floats, creep_range_s: tuple[float, float]
) -> list[PriorGroup]:
    """List the unknowns of a fit, the curve first.

    Args:
        parts: effects to fit.
        initial_curve: start values of c1, c2, c3.
        creep_range_s: shortest and longest observable time constant of creep.
    """
    first = tuple(initial_curve.tolist())
    # The slope at zero is at least a hundredth of the force at the end of the range.
    least = (0.01 * sum(first), -_NO_LIMIT, -_NO_LIMIT)
    unknowns = [PriorGroup("curve", first, _NO_LIMIT, least, (_NO_LIMIT,) * 3)]
    if parts.late_s is not None:
        likely_s, near_s = parts.late_s
        most_s = _LATE_MOST * near_s
        ends = ((likely_s - most_s,), (likely_s + most_s,))
        unknowns.append(PriorGroup("late_s", (likely_s,), near_s, *ends))
    if parts.gas:
        unknowns += _GAS
    if parts.terms:
        unknowns += _make_creep_unknowns(parts.terms, creep_range_s)
    if parts.hysteresis:
        plays = len(WIDTHS_N)
        likely, within, most = _LOOP
        unknowns.append(
            PriorGroup("loop", (likely,) * plays, within, (0.0,) * plays, (most,) * plays)
        )
    if parts.flow:
        unknowns += _FLOW
    return unknowns


def compute_creep_range_s(points: LoadingPoints) -> tuple[float, float]:
    """Return the shortest and the longest time constant of creep that the points determine."""
    step_s = float(np.median(np.diff(points.t_s)))
    begins = np.searchsorted(points.loading, np.arange(points.n_loadings))
    longest_s = float(np.diff(np.append(points.t_s[begins], points.t_s[-1])).max())
    least, most = _CREEP_S
    least = max(least, _STEPS_MIN * step_s)
    return least, max(4.0 * least, min(most, longest_s))
