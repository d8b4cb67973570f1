"""Gas, rubber and hysteresis of a tile as an output-error problem.

All parameters at once are fitted to the pressure that the tile should read under the reference
force. Every loading may have a gain of its own about one, because loadings do not repeat exactly
(paper III-A: 3 %); gains are found in closed form, and how they scatter is a result.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.optimize import nnls

from devices.arrays import Bools, Floats
from service.estimation.effects import EffectName
from service.estimation.fitting.confidence import fit_covariance
from service.estimation.fitting.least_squares import least_squares
from service.estimation.fitting.model import DomeModel, load
from service.estimation.fitting.press import Presses
from service.estimation.models.hysteresis import WIDTHS_N

TERMS = 2  # of the creep: one fast, one slow
_SCATTER = (0.003, 0.03)
"""Least scatter of loadings that is believed; and the paper's scatter, to begin with."""
_ROUNDS = 2  # the second one knows how much loadings scatter
_NO_LIMIT = 1e3  # newtons: no coefficient of a curve of 30 N comes near
_BINS = 15  # parts of the range that systematic errors are averaged over
_OPENS_N = 0.1
"""A tile with less force is at rest."""


Fitted = EffectName | Literal["late"]
"""What is fitted beside the curve."""
_LATE_S = 0.00025
"""How well it is known beforehand when a tile is sampled: somewhere in the first part of a
conversion of 1.6 ms (DS table 7), of which a quarter is assumed."""


@dataclass(frozen=True)
class _Unknowns:
    """Unknowns of an effect: where the search begins, and its bounds."""

    effect: Fitted
    name: str
    start: tuple[float, ...]
    least: tuple[float, ...]
    most: tuple[float, ...]


_UNKNOWNS = (
    _Unknowns("late", "late_s", (0.0,), (-0.0006,), (0.0006,)),
    # No gas has more than air, which has 1.40; a single time for a sphere's many makes it less.
    _Unknowns("gas", "gamma", (1.3,), (1.001,), (1.4,)),
    _Unknowns("gas", "ln_tau", (np.log(0.012),), (-6.5,), (-2.0,)),
    _Unknowns("rubber", "part", (0.04,) * TERMS, (0.0,) * TERMS, (0.4,) * TERMS),
    # A fast and a slow time, whose ranges meet: two times that may change places are not unique.
    _Unknowns(
        "rubber",
        "ln_creep",
        (np.log(0.08), np.log(1.2)),
        (np.log(0.015), np.log(0.3)),
        (np.log(0.3), np.log(6.0)),
    ),
    _Unknowns("hysteresis", "loop", *((x,) * len(WIDTHS_N) for x in (0.05, 0.0, 0.3))),
)


@dataclass(frozen=True)
class Fit:
    """A fitted model.

    Attributes:
        model: its parameters.
        gains: (loadings,), of each loading.
        scatter: standard deviation of the gains.
        modelled: (m, 3), as `pressed` gives it.
        sigma: standard uncertainties by the name of the unknown: "late_s", "gamma", "ln_tau",
            "part", "ln_creep", "loop", as far as they were fitted; and of what neighbouring terms
            trade with one another only the sum: "part_sum", "loop_n".
        curve_covariance: (3, 3), of the curve's coefficients.
        at_bound: unknowns that are at the end of what is possible.
    """

    model: DomeModel
    gains: Floats
    scatter: float
    modelled: Floats
    sigma: dict[str, Floats]
    curve_covariance: Floats
    at_bound: tuple[str, ...]


@dataclass(frozen=True)
class Misfits:
    """Root mean square errors: of the gas' and the creep's corrections, and of the curve."""

    gas: float
    rubber: float
    curve_n: float


class OutputErrorProblem:
    """Least squares of pressures over all parameters.

    Args:
        points: all loadings.
        static: the model without effects, to begin with.
    """

    def __init__(self, points: Presses, static: DomeModel) -> None:
        self._points = points
        self._static = static
        gauge_kpa = points.kpa - static.baseline_kpa
        self._usable = np.isfinite(points.kpa) & (points.weight > 0.0)
        # Beyond the curve's end there is no curve to be fitted to.
        self._usable &= gauge_kpa <= static.scale_kpa
        self._weight = np.where(self._usable, points.weight, 0.0)
        self._gauge_kpa = np.where(self._usable, gauge_kpa, 0.0)
        self._load = load(points.t_s, points.force_n)

    def fit(self, free: frozenset[Fitted]) -> Fit:
        """Fit the curve and the effects that are `free`."""
        curve = self._static.curve
        low, high = np.full(3, -_NO_LIMIT), np.full(3, _NO_LIMIT)
        low[0] = 0.01 * float(curve.sum())  # of the force at the end of the range
        x = curve
        at = {"curve": slice(0, 3)}
        for unknowns in _UNKNOWNS:
            if unknowns.effect in free:
                at[unknowns.name] = slice(len(x), len(x) + len(unknowns.start))
                x = np.append(x, unknowns.start)
                low, high = np.append(low, unknowns.least), np.append(high, unknowns.most)
        # What readings hardly tell is known as well as its bounds say.
        known = (high - low) / np.sqrt(12.0)
        scatter = _SCATTER[1]
        for _ in range(_ROUNDS):

            def residual(x: Floats, scatter: float = scatter) -> Floats:
                return self.residual(self._model(x, at), scatter)

            found = least_squares(residual, x, low, high, known)
            x = found.x
            model = self._model(x, at)
            gains, modelled = self._gains(model, scatter)
            # Gains scatter about their mean, which the curve should have taken: not quite, and
            # there are few of them.
            scatter = max(_SCATTER[0], float(np.sqrt(np.mean((gains - 1.0) ** 2))))
        covariance = fit_covariance(found.jacobian, known)
        every = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        sigma = {name: every[where] for name, where in at.items()}
        for name, total, weights in (
            ("part", "part_sum", np.ones(TERMS)),
            ("loop", "loop_n", WIDTHS_N),
        ):
            if name in at:
                variance = float(weights @ covariance[at[name], at[name]] @ weights)
                sigma[total] = np.array([np.sqrt(max(0.0, variance))])
        at_bound = tuple(name for name, where in at.items() if found.at_bound[where].any())
        curve_covariance = covariance[at["curve"], at["curve"]]
        return Fit(model, gains, scatter, modelled, sigma, curve_covariance, at_bound)

    def misfits(self, fit: Fit) -> Misfits:
        """What the fit leaves of the measured pressures, as parts of what was corrected."""
        rows, points, model = self._usable, self._points, fit.model
        gauge_kpa = fit.modelled[:, 0] - model.baseline_kpa
        residual_kpa = (fit.gains[points.loading] * gauge_kpa - self._gauge_kpa)[rows]
        gas_kpa = (fit.modelled[:, 0] - fit.modelled[:, 1])[rows]
        x = (fit.modelled[:, 1] - model.baseline_kpa)[rows] / model.scale_kpa
        c1, c2, c3 = model.curve
        n_per_kpa = (c1 + x * (2.0 * c2 + x * 3.0 * c3)) / model.scale_kpa
        residual_n = residual_kpa * n_per_kpa
        curve_n = _systematic_n(residual_n, points.force_n[rows], points.fast[rows])
        # Squares beyond those of noise and curve, over the squares of the corrections. The noise is
        # what readings differ by from one to the next: outliers are not among them any more.
        weighted = residual_kpa * self._weight[rows]
        noise = float(np.mean(np.diff(weighted) ** 2)) / 2.0
        variance = noise / self._weight[rows] ** 2 + (curve_n / n_per_kpa) ** 2
        rubber_kpa = fit.modelled[rows, 2] / n_per_kpa
        parts = np.stack([gas_kpa**2, rubber_kpa**2], axis=1) / variance[:, None]
        shares, _ = nnls(parts, residual_kpa**2 / variance - 1.0)
        gas, rubber = np.sqrt(shares)
        return Misfits(gas=float(gas), rubber=float(rubber), curve_n=curve_n)

    def _model(self, x: Floats, at: dict[str, slice]) -> DomeModel:
        model = replace(self._static, curve=x[at["curve"]])
        if "late_s" in at:
            model = replace(model, late_s=float(x[at["late_s"]][0]))
        if "gamma" in at:
            gamma, tau_s = float(x[at["gamma"]][0]), float(np.exp(x[at["ln_tau"]][0]))
            model = replace(model, gamma=gamma, tau_s=tau_s)
        if "part" in at:
            model = replace(model, part=x[at["part"]], creep_s=np.exp(x[at["ln_creep"]]))
        return replace(model, loop=x[at["loop"]]) if "loop" in at else model

    def _gains(self, model: DomeModel, scatter: float) -> tuple[Floats, Floats]:
        """Gain of each loading, by least squares with a prior of one, and modelled pressures."""
        points = self._points
        modelled = model.pressed(points.t_s, self._load(points.t_s + model.late_s))
        gauge_kpa = modelled[:, 0] - model.baseline_kpa
        n = points.loadings
        prior = 1.0 / scatter**2
        square = np.bincount(points.loading, (self._weight * gauge_kpa) ** 2, n)
        product = np.bincount(points.loading, self._weight**2 * gauge_kpa * self._gauge_kpa, n)
        return (product + prior) / (square + prior), modelled

    def residual(self, model: DomeModel, scatter: float) -> Floats:
        """What is fitted: pressures, gains and priors off, in their standard uncertainties."""
        gains, modelled = self._gains(model, scatter)
        gauge_kpa = modelled[:, 0] - model.baseline_kpa
        off = (gains[self._points.loading] * gauge_kpa - self._gauge_kpa) * self._weight
        return np.concatenate([off, (gains - 1.0) / scatter, [model.late_s / _LATE_S]])


def _systematic_n(residual_n: Floats, force_n: Floats, fast: Bools) -> float:
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
