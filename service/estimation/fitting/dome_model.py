"""Forward model of a dome: reference force in, pressure out.

The models of an estimate in the opposite direction, sample by sample: creep, loop, curve, gas. A
fit in this direction leaves the noise in the pressure; a fit of the inverse would explain it away
(gamma = 46).

Priors separate effects that look alike, such as a cooling gas and a fast creep: every unknown has a
likely value with a standard deviation. Informative readings outweigh the prior; without them
the prior is the result, with its uncertainty.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.interpolate import PchipInterpolator

from devices.arrays import Floats
from devices.jit import jit_cached
from service.estimation.effects import FLOW_FRACTION_MAX, FLOW_STRESS_MIN_N
from service.estimation.fitting.rig.indentation import LoadingPoints
from service.estimation.models.flow import step_branch_stress
from service.estimation.models.hysteresis import WIDTHS_N, step_play_closed_at_zero_load
from service.estimation.models.rubber import compute_creep_weights

_NEWTON_STEPS = 30  # a bound; it ends when a step is below `_CLOSE`
_GAS_STEPS = 30  # likewise; two are the rule
_CLOSE = 1e-10
"""Step at which the iteration ends: the next one would be its square."""
_FLAT = 1e-5
"""Argument below which a difference of exponentials is computed by its series."""
_FLATTEST = 0.05
"""Least slope of a trial cubic, as a part of the slope at zero."""


class DomeResponse(NamedTuple):
    """Absolute pressure, that without the gas' heat, and force less apparent force; (n,) each."""

    kpa: Floats
    isothermal_kpa: Floats
    force_lag_n: Floats


_NONE = np.zeros(0)


class DomeModel(NamedTuple):
    """Parameters of one tile; the defaults are those of the static curve alone.

    Attributes:
        curve: c1, c2, c3 of force over x = gauge / `scale_kpa`.
        scale_kpa: end of the curve.
        baseline_kpa: absolute pressure unloaded.
        wall_per_kpa: compliance of the wall, part of the volume for a kPa.
        gamma: ratio of heat capacities; 1 for no gas effect.
        tau_s: the gas' time constant.
        part: (terms,), fractions of the creep.
        creep_s: (terms,), its time constants.
        loop: (plays,), weights of the plays of half widths `WIDTHS_N`.
        flow_part: fraction of the viscous branch; 0 for none.
        flow_n: force on it during a slow stroke.
        flow_power: exponent of its flow over that force.
        late_s: delay of the tile's samples behind their instants. Forces passed to
            `compute_response` have to be those at the delayed instants, from
            `make_clamped_pchip_force`.
    """

    curve: Floats
    scale_kpa: float
    baseline_kpa: float
    wall_per_kpa: float
    gamma: float = 1.0
    tau_s: float = 1.0
    part: Floats = _NONE
    creep_s: Floats = _NONE
    loop: Floats = _NONE
    flow_part: float = 0.0
    flow_n: float = 1.0
    flow_power: float = 4.0
    late_s: float = 0.0

    def compute_response(self, t_s: Floats, force_n: Floats) -> DomeResponse:
        """Compute the response to forces that are linear between instants, (n,) each."""
        return _compute_dome_response(self, t_s, force_n)


def make_clamped_pchip_force(t_s: Floats, force_n: Floats) -> Callable[[Floats], Floats]:
    """Make a PCHIP interpolator of a reference's readings, constant beyond them.

    Along straight lines a fit of the delay would stop at every reading, where they have a corner.
    """
    between = PchipInterpolator(t_s, force_n)
    first_s, last_s = t_s[0], t_s[-1]
    return lambda at_s: np.asarray(between(np.clip(at_s, first_s, last_s)))


@jit_cached
def _solve_heated_pressure(
    static: float,
    baseline_kpa: float,
    ln_before: float,
    warm: float,
    h: float,
    k: float,
    wall: float,
) -> tuple[float, float]:
    """Solve for the pressure of a gas that would cool to `static`, and its temperature ratio.

    Newton's method in the logarithm of the pressure (model `gas`).
    """
    ln_static = math.log(static)
    ln_p = ln_before
    p = math.exp(ln_p)
    now = warm
    for _ in range(_GAS_STEPS):
        x = h - k * (ln_p - ln_before)
        decay = math.exp(-x)
        mean = (1.0 - decay) / x if abs(x) > _FLAT else 1.0 - 0.5 * x
        slope = (mean - decay) / x if abs(x) > _FLAT else 0.5 - x / 3.0
        now = warm * decay + h * mean
        rise = k * (warm * decay + h * slope) / now  # d ln T / d ln p
        iso = p / now
        inner, outer = 1.0 + wall * (iso - baseline_kpa), 1.0 + wall * (p - baseline_kpa)
        give = wall * (iso * (1.0 - rise) / inner - p / outer)  # derivative of the wall's share
        step = (ln_static + math.log(now * inner / outer) - ln_p) / (1.0 - rise - give)
        ln_p += step
        p = math.exp(ln_p)
        if abs(step) < _CLOSE:
            break
    return p, now


@jit_cached
def _compute_dome_response(model: DomeModel, t_s: Floats, force_n: Floats) -> DomeResponse:
    n = len(t_s)
    out = DomeResponse(np.empty(n), np.empty(n), np.empty(n))
    c1, c2, c3 = model.curve[0], model.curve[1], model.curve[2]
    flattest = _FLATTEST * c1
    gamma, baseline_kpa = model.gamma, model.baseline_kpa
    part, creep_s, loop = model.part, model.creep_s, model.loop
    crept, plays = np.zeros(len(part)), np.zeros(len(loop))
    k = (gamma - 1.0) / gamma
    x, warm, force, time = 0.0, 1.0, 0.0, t_s[0]
    stress, through = 0.0, 0.0
    ln_p = math.log(baseline_kpa)
    for i in range(n):
        dt = t_s[i] - time
        apparent = force_n[i]
        for m in range(len(part)):
            decay, of_before, of_now = compute_creep_weights(dt / creep_s[m])
            crept[m] = decay * crept[m] + of_before * force + of_now * force_n[i]
            apparent -= part[m] * (force_n[i] - crept[m])
        lag = 0.0
        for m in range(len(loop)):
            plays[m] = step_play_closed_at_zero_load(apparent, WIDTHS_N[m], plays[m])
            lag += loop[m] * (plays[m] - apparent)
        apparent += lag
        if model.flow_part > 0.0:
            stress = step_branch_stress(
                stress, model.flow_part, model.flow_n, model.flow_power, apparent - through, dt
            )
            through = apparent
            apparent -= stress
        for _ in range(_NEWTON_STEPS):
            inside = min(max(x, 0.0), 1.0)
            slope = max(flattest, c1 + inside * (2.0 * c2 + 3.0 * c3 * inside))
            value = inside * (c1 + inside * (c2 + inside * c3)) + (x - inside) * slope
            step = (apparent - value) / slope
            x += step
            if abs(step) < _CLOSE:
                break
        static = baseline_kpa + x * model.scale_kpa
        p = static * warm
        if gamma > 1.0:
            p, warm = _solve_heated_pressure(
                static, baseline_kpa, ln_p, warm, dt / (gamma * model.tau_s), k, model.wall_per_kpa
            )
        out.kpa[i], out.isothermal_kpa[i], out.force_lag_n[i] = p, static, force_n[i] - apparent
        ln_p, force, time = math.log(p), force_n[i], t_s[i]
    return out


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
