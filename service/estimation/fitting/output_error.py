"""Output-error fit of a tile's gas, rubber and hysteresis.

All parameters at once are fitted to the pressure of the tile under the reference force. Every
loading has its own gain about one, because loadings do not repeat exactly (paper III-A: 3 %). Gains
are found in closed form; their scatter is a result.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.optimize import nnls

from devices.arrays import Bools, Floats
from service.estimation.fitting.dome_model import (
    DomeModel,
    DomeResponse,
    FittedEffects,
    compute_creep_range_s,
    list_unknowns,
    make_clamped_pchip_force,
)
from service.estimation.fitting.least_squares import (
    COST_TOLERANCE,
    LeastSquaresResult,
    compute_fit_covariance,
    compute_step_beyond_bound,
    minimize_squares,
)
from service.estimation.fitting.rig.indentation import LoadingPoints
from service.estimation.models.hysteresis import WIDTHS_N

_SCATTER = (0.003, 0.03)
"""Least scatter of loadings, and the start value: the paper's."""
_ROUGHLY = 1.0
"""End of the first search, which determines the scatter for the second."""
_MODEL = 0.01
"""Unmodelled part of a pressure: a tenth of the corrections, which are a tenth. Without it readings
under large loads would distort the curve at small ones."""
_BINS = 15  # bins of the range for averages of systematic errors
_OF_RUBBER = ("part", "ln_creep", "loop", "flow_part", "ln_flow_n", "flow_power")
_OPENS_N = 0.1
"""Largest force on a tile at rest."""


@dataclass(frozen=True)
class DomeFit:
    """Fitted model of a dome.

    Attributes:
        model: fitted parameters.
        gains: (loadings,), gain of each loading.
        scatter: standard deviation of the gains.
        response: of the tile to the forces, (m,).
        sigma: standard uncertainties by the name of the unknown: "late_s", "gamma", "ln_tau",
            "part", "ln_creep", "loop", "flow_part", "ln_flow_n", "flow_power", if fitted; and of
            sums over neighbouring terms, which are correlated: "part_sum", "loop_n".
        curve_covariance: (3, 3), covariance of the curve's coefficients.
        at_bound: names of unknowns at a bound.
        n_unknowns: number of unknowns.
        left_out_squares: (loadings,), leave-one-loading-out sums of squares.
        correction_uncertainty: relative uncertainty of the corrections "gas" and "rubber" by their
            parameters, root mean square in the rig.
    """

    model: DomeModel
    gains: Floats
    scatter: float
    response: DomeResponse
    sigma: dict[str, Floats]
    curve_covariance: Floats
    at_bound: tuple[str, ...]
    n_unknowns: int
    left_out_squares: Floats
    correction_uncertainty: dict[str, float]


@dataclass(frozen=True)
class CorrectionMisfits:
    """Root mean square errors of the gas correction, of the creep correction, and of the curve."""

    gas: float
    rubber: float
    curve_n: float


class OutputErrorProblem:
    """Least squares of pressures over all parameters.

    Args:
        points: all loadings.
        static: start model, without effects.
    """

    def __init__(self, points: LoadingPoints, static: DomeModel) -> None:
        self._points = points
        self._static = static
        gauge_kpa = points.kpa - static.baseline_kpa
        self._usable = np.isfinite(points.kpa) & (points.weight > 0.0)
        # No curve exists beyond its end.
        self._usable &= gauge_kpa <= static.scale_kpa
        self._gauge_kpa = np.where(self._usable, gauge_kpa, 0.0)
        noise_kpa = 1.0 / np.where(self._usable, points.weight, 1.0)
        weight = 1.0 / np.hypot(noise_kpa, _MODEL * self._gauge_kpa)
        self._weight = np.where(self._usable, weight, 0.0)
        between = make_clamped_pchip_force(points.t_s, points.force_n)
        # Depends on one unknown only, and interpolation costs as much as the smaller models.
        self._force_n = lru_cache(maxsize=2)(lambda late_s: between(points.t_s + late_s))
        self._told_s = compute_creep_range_s(points)

    def fit(self, parts: FittedEffects, scatter: float | None = None) -> DomeFit:
        """Fit the curve and these effects.

        Args:
            parts: effects to fit.
            scatter: of the loadings; None: determine it.
        """
        unknowns = list_unknowns(parts, self._static.curve, self._told_s)
        likely = np.concatenate([u.prior for u in unknowns])
        within = np.concatenate([np.full(len(u.prior), u.prior_sigma) for u in unknowns])
        low = np.concatenate([u.lower for u in unknowns])
        high = np.concatenate([u.upper for u in unknowns])
        at: dict[str, slice] = {}
        stop = 0
        for each in unknowns:
            at[each.name] = slice(stop, stop + len(each.prior))
            stop += len(each.prior)
        x = np.clip(likely, low, high)
        known = scatter is not None
        scatter = _SCATTER[1] if scatter is None else scatter
        for enough in (COST_TOLERANCE,) if known else (_ROUGHLY, COST_TOLERANCE):

            def residual(x: Floats, scatter: float = scatter) -> Floats:
                off = self.compute_pressure_and_gain_residuals(self._make_model(x, at), scatter)
                return np.concatenate([off, (x - likely) / within])

            found = minimize_squares(residual, x, low, high, within, enough)
            x = found.x
            model = self._make_model(x, at)
            gains, response = self._fit_gains(model, scatter)
            # About 1, not about their mean: the curve absorbs most of the mean, and they are few.
            if not known:
                scatter = max(_SCATTER[0], float(np.sqrt(np.mean((gains - 1.0) ** 2))))
        read = slice(0, len(found.residual) - len(x))
        jacobian, off = found.jacobian[read], found.residual[read]
        covariance = compute_fit_covariance(jacobian, within)
        every = np.hypot(
            np.sqrt(np.maximum(np.diag(covariance), 0.0)),
            compute_step_beyond_bound(jacobian, off, within, found.at_bound),
        )
        sigma = {name: every[where] for name, where in at.items()}
        for name, total, weights in (
            ("part", "part_sum", np.ones(parts.terms)),
            ("loop", "loop_n", WIDTHS_N),
        ):
            if name in at:
                variance = float(weights @ covariance[at[name], at[name]] @ weights)
                sigma[total] = np.array([np.sqrt(max(0.0, variance))])
        return DomeFit(
            model=model,
            gains=gains,
            scatter=scatter,
            response=response,
            sigma=sigma,
            curve_covariance=covariance[at["curve"], at["curve"]],
            at_bound=tuple(name for name, where in at.items() if found.at_bound[where].any()),
            n_unknowns=len(x),
            left_out_squares=self._compute_left_out_squares(found, within),
            correction_uncertainty=self._compute_correction_uncertainty(
                jacobian, covariance, response, model, at
            ),
        )

    def _compute_left_out_squares(self, found: LeastSquaresResult, within: Floats) -> Floats:
        """Return leave-one-loading-out sums of squares, to first order.

        Without the residuals r of a loading and their slopes J, the unknowns would move by
        (all J'J - J'J)^-1 J'r.
        """
        free = ~found.at_bound
        slopes = found.jacobian[:, free] * within[free]
        normal = slopes.T @ slopes
        m, n = len(self._points.loading), self._points.n_loadings
        squares = np.zeros(n)
        # Points in the order of time, then the gains: loading by loading is row by row.
        begins = np.searchsorted(self._points.loading, np.arange(n + 1))
        for k in range(n):
            rows = np.append(np.arange(begins[k], begins[k + 1]), m + k)
            own, off = slopes[rows], found.residual[rows]
            moved = np.linalg.solve(normal - own.T @ own, own.T @ off)
            squares[k] = float(((off + own @ moved) ** 2).sum())
        return squares

    def _compute_correction_uncertainty(
        self,
        jacobian: Floats,
        covariance: Floats,
        response: DomeResponse,
        model: DomeModel,
        at: dict[str, slice],
    ) -> dict[str, float]:
        """Compute `DomeFit.correction_uncertainty`."""
        x = (response.isothermal_kpa - model.baseline_kpa) / model.scale_kpa
        corrected = {
            "gas": (("gamma", "ln_tau"), response.kpa - response.isothermal_kpa),
            "rubber": (_OF_RUBBER, response.force_lag_n / _compute_slope_n_per_kpa(model, x)),
        }
        unsure = {}
        for name, (names, kpa) in corrected.items():
            columns = [i for each in names if each in at for i in range(*at[each].indices(1000))]
            slopes = jacobian[: len(x), columns]
            variance = ((slopes @ covariance[np.ix_(columns, columns)]) * slopes).sum()
            square = float(((self._weight * kpa) ** 2).sum())
            unsure[name] = float(np.sqrt(variance / square)) if square > 0.0 else 0.0
        return unsure

    def compute_relative_correction_misfits(self, fit: DomeFit) -> CorrectionMisfits:
        """Compute the fit's residual errors relative to the corrections."""
        rows, points, model = self._usable, self._points, fit.model
        gauge_kpa = fit.response.kpa - model.baseline_kpa
        residual_kpa = (fit.gains[points.loading] * gauge_kpa - self._gauge_kpa)[rows]
        gas_kpa = (fit.response.kpa - fit.response.isothermal_kpa)[rows]
        x = (fit.response.isothermal_kpa - model.baseline_kpa)[rows] / model.scale_kpa
        n_per_kpa = _compute_slope_n_per_kpa(model, x)
        residual_n = residual_kpa * n_per_kpa
        curve_n = _compute_systematic_error_n(
            residual_n, points.force_n[rows], points.is_fast[rows]
        )
        # Squares beyond those of noise and curve, over the squares of the corrections. The noise is
        # that of differences of successive readings, without outliers.
        weighted = residual_kpa * self._weight[rows]
        noise = float(np.mean(np.diff(weighted) ** 2)) / 2.0
        variance = noise / self._weight[rows] ** 2 + (curve_n / n_per_kpa) ** 2
        rubber_kpa = fit.response.force_lag_n[rows] / n_per_kpa
        parts = np.stack([gas_kpa**2, rubber_kpa**2], axis=1) / variance[:, None]
        shares, _ = nnls(parts, residual_kpa**2 / variance - 1.0)
        gas, rubber = np.hypot(
            np.sqrt(shares),
            [fit.correction_uncertainty["gas"], fit.correction_uncertainty["rubber"]],
        )
        return CorrectionMisfits(gas=float(gas), rubber=float(rubber), curve_n=curve_n)

    def _make_model(self, x: Floats, at: dict[str, slice]) -> DomeModel:
        model = self._static._replace(curve=x[at["curve"]])
        if "late_s" in at:
            model = model._replace(late_s=float(x[at["late_s"]][0]))
        if "gamma" in at:
            gamma, tau_s = float(x[at["gamma"]][0]), float(np.exp(x[at["ln_tau"]][0]))
            model = model._replace(gamma=gamma, tau_s=tau_s)
        if "part" in at:
            model = model._replace(part=x[at["part"]], creep_s=np.exp(x[at["ln_creep"]]))
        if "flow_part" in at:
            part, flow_n = float(x[at["flow_part"]][0]), float(np.exp(x[at["ln_flow_n"]][0]))
            power = float(x[at["flow_power"]][0])
            model = model._replace(flow_part=part, flow_n=flow_n, flow_power=power)
        return model._replace(loop=x[at["loop"]]) if "loop" in at else model

    def _fit_gains(self, model: DomeModel, scatter: float) -> tuple[Floats, DomeResponse]:
        """Compute the gain of each loading, with a prior of one, and the tile's response."""
        points = self._points
        response = model.compute_response(points.t_s, self._force_n(model.late_s))
        gauge_kpa = response.kpa - model.baseline_kpa
        n = points.n_loadings
        prior = 1.0 / scatter**2
        square = np.bincount(points.loading, (self._weight * gauge_kpa) ** 2, n)
        product = np.bincount(points.loading, self._weight**2 * gauge_kpa * self._gauge_kpa, n)
        return (product + prior) / (square + prior), response

    def compute_pressure_and_gain_residuals(self, model: DomeModel, scatter: float) -> Floats:
        """Compute the residuals of pressures and gains in their standard uncertainties."""
        gains, response = self._fit_gains(model, scatter)
        gauge_kpa = response.kpa - model.baseline_kpa
        off = (gains[self._points.loading] * gauge_kpa - self._gauge_kpa) * self._weight
        return np.concatenate([off, (gains - 1.0) / scatter])

    @property
    def max_force_n(self) -> float:
        """Largest reference force."""
        return float(self._points.force_n.max())

    def compute_max_heat_effect_n(self, fit: DomeFit) -> float:
        """Return the largest effect of the gas' heat on a force."""
        model, rows = fit.model, self._usable
        heated_kpa, settled_kpa = fit.response.kpa[rows], fit.response.isothermal_kpa[rows]
        slope = _compute_slope_n_per_kpa(
            model, (settled_kpa - model.baseline_kpa) / model.scale_kpa
        )
        return float(np.abs((heated_kpa - settled_kpa) * slope).max())

    def compute_pressure_and_gain_cost(self, model: DomeModel, scatter: float) -> float:
        """Compute the sum of squared residuals."""
        off = self.compute_pressure_and_gain_residuals(model, scatter)
        return float(off @ off)


def _compute_slope_n_per_kpa(model: DomeModel, x: Floats) -> Floats:
    """Compute the slope of the curve at parts x of its range."""
    c1, c2, c3 = model.curve
    return np.asarray((c1 + x * (2.0 * c2 + x * 3.0 * c3)) / model.scale_kpa)


def _compute_systematic_error_n(residual_n: Floats, force_n: Floats, fast: Bools) -> float:
    """Return the root mean square error of the curve where slow strokes agree with one another.

    Means over `_BINS` parts of the range of force, on the way in and on the way out.
    """
    slow = fast if fast.all() else ~fast  # only strokes that continue into taps
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
