"""Gas, rubber and hysteresis of a tile from its bench recording, as an output-error problem.

All parameters at once are fitted to the pressure that the tile should read under the reference
force. Every loading may have a gain of its own about one, because loadings do not repeat exactly
(paper III-A: 3 %); gains are found in closed form, and how they scatter is a result.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares, nnls

from devices.arrays import Bools, Floats
from service.estimation.bench.model import pressed
from service.estimation.bench.press import Presses
from service.estimation.effects import (
    EffectName,
    Effects,
    GasEffect,
    HysteresisEffect,
    Parameter,
    RubberEffect,
    TemperatureEffect,
)
from service.estimation.models.hysteresis import WIDTHS_N

TERMS = 2
_SCATTER = (0.003, 0.03)
"""Least scatter of loadings that is believed, and the paper's, to begin with."""
_ROUNDS = 2
_EVALUATIONS = 60
_CLEAR = 3.0
"""An effect is determined if it is so many standard uncertainties from none."""
_LN_SIGMA_MAX = 0.7
"""A time constant is determined within a factor of two."""
_GAMMA_MAX = 1.45
"""Air has 1.40; a single time constant for a sphere makes it less, never more."""
_FAST_MIN = 50
"""Readings of holds, releases and taps, without which nothing fast can be told."""

_NO_LIMIT = 1e3
_BINS = 15
_OPENS_N = 0.1
"""What is pressed with less is at rest."""


@dataclass(frozen=True)
class _Free:
    """Which effects are fitted."""

    gas: bool
    rubber: bool
    loop: bool


@dataclass(frozen=True)
class _Found:
    """One fit; arrays are as in `pressed`."""

    curve: Floats
    gamma: float
    tau_s: float
    part: Floats
    creep_s: Floats
    loop: Floats
    gains: Floats
    sigma: dict[str, Floats]
    curve_covariance: Floats
    modelled: Floats
    scatter: float


def identify(
    points: Presses,
    *,
    scale_kpa: float,
    baseline_kpa: float,
    first_curve: Floats,
    temperature: TemperatureEffect | None,
    why_no_temperature: str,
) -> Effects:
    """What of gas, rubber and hysteresis the recording determines.

    Args:
        points: all loadings.
        scale_kpa: end of the calibrated range.
        baseline_kpa: absolute pressure unloaded.
        first_curve: c1, c2, c3 of the static curve over gauge / `scale_kpa`, to begin with.
        temperature: from the soak; its wall's give is used.
        why_no_temperature: the reason if there is none.
    """
    refused: dict[EffectName, str] = {}
    if temperature is None:
        refused["temperature"] = why_no_temperature
        refused["ambient"] = why_no_temperature
    wall = Effects(temperature=temperature).wall_per_kpa
    problem = _Problem(points, scale_kpa, baseline_kpa, wall)
    free = _Free(gas=int(points.fast.sum()) >= _FAST_MIN, rubber=True, loop=True)
    if not free.gas:
        refused["gas"] = "no holds, releases or taps in the recording"
    while True:
        found = problem.fit(free, first_curve)
        reasons = _undetermined(found, free)
        refused |= reasons
        if not reasons:
            break
        # One at a time: what looked undetermined may be so only beside another.
        worst = next(name for name in ("gas", "hysteresis", "rubber") if name in reasons)
        for name in reasons:
            if name != worst:
                del refused[name]
        free = replace(
            free,
            gas=free.gas and worst != "gas",
            loop=free.loop and worst != "hysteresis",
            rubber=free.rubber and worst != "rubber",
        )
    misfits = problem.misfits(found)
    return Effects(
        gas=GasEffect(
            gamma=_parameter(found.gamma, found.sigma["gamma"]),
            tau_s=_parameter(found.tau_s, found.tau_s * found.sigma["ln_tau"]),
            misfit=misfits.gas,
        )
        if free.gas
        else None,
        rubber=RubberEffect(
            part=_parameters(found.part, found.sigma["part"]),
            tau_s=_parameters(found.creep_s, found.creep_s * found.sigma["ln_creep"]),
            coefficients=(0.0, float(found.curve[0]), float(found.curve[1]), float(found.curve[2])),
            covariance=tuple(tuple(float(c) for c in row) for row in found.curve_covariance),
            scatter=found.scatter,
            misfit=misfits.rubber,
            curve_misfit_n=misfits.curve_n,
        )
        if free.rubber
        else None,
        hysteresis=HysteresisEffect(part=_parameters(found.loop, found.sigma["loop"]))
        if free.loop
        else None,
        temperature=temperature,
        refused=refused,
    )


@dataclass(frozen=True)
class _Misfits:
    """What is wrong, root mean square: of the gas' and the creep's corrections, and the curve."""

    gas: float
    rubber: float
    curve_n: float


class _Problem:
    """Least squares of pressures over all parameters."""

    def __init__(self, points: Presses, scale_kpa: float, baseline_kpa: float, wall: float) -> None:
        self._points = points
        self._scale_kpa = scale_kpa
        self._baseline_kpa = baseline_kpa
        self._wall = wall
        self._usable = np.isfinite(points.kpa) & (points.weight > 0.0)
        # Beyond the curve's end there is no curve to be fitted to.
        self._usable &= points.kpa - baseline_kpa <= scale_kpa
        self._weight = np.where(self._usable, points.weight, 0.0)
        self._gauge_kpa = np.where(self._usable, points.kpa - baseline_kpa, 0.0)

    def fit(self, free: _Free, first_curve: Floats) -> _Found:
        c = float(first_curve.sum())  # force at the end of the range
        names: list[tuple[str, list[float], float, float]] = [
            ("curve", [float(x) for x in first_curve], -_NO_LIMIT, _NO_LIMIT),
        ]
        if free.gas:
            names += [("gamma", [1.3], 1.001, 1.6), ("ln_tau", [np.log(0.012)], -6.5, -2.0)]
        if free.rubber:
            names += [("part", [0.04] * TERMS, 0.0, 0.4)]
            names += [("ln_creep_fast", [np.log(0.08)], np.log(0.015), np.log(0.3))]
            names += [("ln_creep_slow", [np.log(1.2)], np.log(0.3), np.log(6.0))]
        if free.loop:
            names += [("loop", [0.05] * len(WIDTHS_N), 0.0, 0.3)]
        at: dict[str, slice] = {}
        start: list[float] = []
        low: list[float] = []
        high: list[float] = []
        for name, values, least, most in names:
            at[name] = slice(len(start), len(start) + len(values))
            start += values
            low += [least] * len(values)
            high += [most] * len(values)
        low[0] = 0.01 * c
        scatter = _SCATTER[1]
        x = np.array(start)
        for _ in range(_ROUNDS):

            def residual(x: Floats, scatter: float = scatter) -> Floats:
                return self._residual(self._unpacked(x, at, free), scatter)

            found = least_squares(
                residual,
                x,
                bounds=(np.array(low), np.array(high)),
                x_scale="jac",
                max_nfev=_EVALUATIONS,
            )
            x = found.x
            result = self._unpacked(x, at, free)
            gains, modelled = self._gains(result, scatter)
            # Gains scatter about their mean, which the curve should have taken: not quite, and
            # there are few of them.
            scatter = max(_SCATTER[0], float(np.sqrt(np.mean((gains - 1.0) ** 2))))
        jacobian = np.asarray(found.jac)
        covariance = np.linalg.pinv(jacobian.T @ jacobian)
        sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        nothing = np.zeros(TERMS)
        return replace(
            result,
            gains=gains,
            modelled=modelled,
            scatter=scatter,
            curve_covariance=covariance[at["curve"], at["curve"]],
            sigma={
                "gamma": sigma[at["gamma"]] if free.gas else nothing,
                "ln_tau": sigma[at["ln_tau"]] if free.gas else nothing,
                "part": sigma[at["part"]] if free.rubber else nothing,
                "ln_creep": np.concatenate([sigma[at["ln_creep_fast"]], sigma[at["ln_creep_slow"]]])
                if free.rubber
                else nothing,
                "loop": sigma[at["loop"]] if free.loop else nothing,
                # Of the sums: the parts of neighbouring terms trade with one another.
                "part_sum": _sigma_of_sum(covariance, at["part"], np.ones(TERMS))
                if free.rubber
                else nothing,
                "loop_n": _sigma_of_sum(covariance, at["loop"], WIDTHS_N) if free.loop else nothing,
            },
        )

    def misfits(self, found: _Found) -> _Misfits:
        """What the fit leaves of the measured pressures, as parts of what was corrected."""
        rows, points = self._usable, self._points
        gauge_kpa = found.modelled[:, 0] - self._baseline_kpa
        residual_kpa = (found.gains[points.loading] * gauge_kpa - self._gauge_kpa)[rows]
        gas_kpa = (found.modelled[:, 0] - found.modelled[:, 1])[rows]
        x = (found.modelled[:, 1] - self._baseline_kpa)[rows] / self._scale_kpa
        c1, c2, c3 = found.curve
        n_per_kpa = (c1 + x * (2.0 * c2 + x * 3.0 * c3)) / self._scale_kpa
        residual_n = residual_kpa * n_per_kpa
        curve_n = _systematic(residual_n, points.force_n[rows], points.fast[rows])
        # Squares beyond those of noise and curve, over the squares of the corrections. The noise is
        # what readings differ by from one to the next: outliers are not among them any more.
        weighted = residual_kpa * self._weight[rows]
        noise = float(np.mean(np.diff(weighted) ** 2)) / 2.0
        variance = noise / self._weight[rows] ** 2 + (curve_n / n_per_kpa) ** 2
        rubber_kpa = found.modelled[rows, 2] / n_per_kpa
        parts = np.stack([gas_kpa**2, rubber_kpa**2], axis=1) / variance[:, None]
        shares, _ = nnls(parts, residual_kpa**2 / variance - 1.0)
        gas, rubber = np.sqrt(shares)
        return _Misfits(gas=float(gas), rubber=float(rubber), curve_n=curve_n)

    def _unpacked(self, x: Floats, at: dict[str, slice], free: _Free) -> _Found:
        none = np.zeros(0)
        return _Found(
            curve=x[at["curve"]],
            gamma=float(x[at["gamma"]][0]) if free.gas else 1.0,
            tau_s=float(np.exp(x[at["ln_tau"]][0])) if free.gas else 1.0,
            part=x[at["part"]] if free.rubber else none,
            creep_s=np.exp(np.concatenate([x[at["ln_creep_fast"]], x[at["ln_creep_slow"]]]))
            if free.rubber
            else none,
            loop=x[at["loop"]] if free.loop else none,
            gains=none,
            sigma={},
            curve_covariance=none,
            modelled=none,
            scatter=0.0,
        )

    def _gains(self, f: _Found, scatter: float) -> tuple[Floats, Floats]:
        points = self._points
        modelled = pressed(
            points.t_s,
            points.force_n,
            f.curve,
            self._scale_kpa,
            self._baseline_kpa,
            f.gamma,
            f.tau_s,
            self._wall,
            f.part,
            f.creep_s,
            f.loop,
            WIDTHS_N,
        )
        gauge_kpa = modelled[:, 0] - self._baseline_kpa
        n = points.loadings
        prior = 1.0 / scatter**2
        square = np.bincount(points.loading, (self._weight * gauge_kpa) ** 2, n)
        product = np.bincount(points.loading, self._weight**2 * gauge_kpa * self._gauge_kpa, n)
        return (product + prior) / (square + prior), modelled

    def _residual(self, f: _Found, scatter: float) -> Floats:
        gains, modelled = self._gains(f, scatter)
        gauge_kpa = modelled[:, 0] - self._baseline_kpa
        off = (gains[self._points.loading] * gauge_kpa - self._gauge_kpa) * self._weight
        return np.concatenate([off, (gains - 1.0) / scatter])


def _systematic(
    residual_n: Floats,
    force_n: Floats,
    fast: Bools,
) -> float:
    """How far the curve is off where slow strokes agree with one another, root mean square.

    Means over `_BINS` parts of the range of force, on the way in and on the way out.
    """
    slow = ~fast
    rising = np.gradient(force_n) > 0.0
    full_n = force_n[slow].max()
    squares = []
    for branch in (rising, ~rising):
        rows = slow & branch & (force_n > _OPENS_N)
        # Narrower for small forces, where a cubic through zero errs on a short stretch.
        place = np.sqrt(np.minimum(force_n[rows] / full_n, 1.0))
        index = np.minimum((_BINS * place).astype(np.int64), _BINS - 1)
        count = np.bincount(index, minlength=_BINS)
        total = np.bincount(index, residual_n[rows], minlength=_BINS)
        squares.append((total[count > 0] / count[count > 0]) ** 2)
    return float(np.sqrt(np.mean(np.concatenate(squares))))


def _undetermined(found: _Found, free: _Free) -> dict[EffectName, str]:
    reasons: dict[EffectName, str] = {}
    if free.gas:
        sigma, ln_sigma = float(found.sigma["gamma"][0]), float(found.sigma["ln_tau"][0])
        if found.gamma > _GAMMA_MAX:
            reasons["gas"] = (
                f"gamma {found.gamma:.2f} is more than a gas can have: tile and reference are not "
                "of the same instants, or the spindle slipped"
            )
        elif found.gamma - 1.0 < _CLEAR * sigma or ln_sigma > _LN_SIGMA_MAX:
            reasons["gas"] = (
                f"gamma {found.gamma:.3f} +- {sigma:.3f}, tau {found.tau_s * 1e3:.1f} ms within a "
                f"factor of {np.exp(ln_sigma):.1f}: not determined"
            )
    if free.rubber:
        total, sigma = float(found.part.sum()), float(found.sigma["part_sum"][0])
        if total < _CLEAR * sigma:
            reasons["rubber"] = f"creeping part {total:.3f} +- {sigma:.3f}: not determined"
    if free.loop:
        width_n, sigma = float(found.loop @ WIDTHS_N), float(found.sigma["loop_n"][0])
        if width_n < _CLEAR * sigma:
            reasons["hysteresis"] = f"half width {width_n:.2f} +- {sigma:.2f} N: not determined"
    return reasons


def _sigma_of_sum(covariance: Floats, at: slice, weights: Floats) -> Floats:
    variance = float(weights @ covariance[at, at] @ weights)
    return np.array([np.sqrt(max(0.0, variance))])


def _parameter(value: float, sigma: npt.ArrayLike) -> Parameter:
    return Parameter(value=value, sigma=float(np.ravel(sigma)[0]))


def _parameters(values: Floats, sigmas: Floats) -> tuple[Parameter, ...]:
    return tuple(
        Parameter(value=float(value), sigma=float(sigma))
        for value, sigma in zip(values, sigmas, strict=True)
    )
