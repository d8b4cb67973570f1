"""Selection and fit of a tile's gas, rubber and hysteresis effects."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from scipy.special import chdtrc

from devices.arrays import Floats
from service.estimation.effects import (
    EffectName,
    Effects,
    FlowEffect,
    GasEffect,
    HysteresisEffect,
    Parameter,
    RubberEffect,
    TemperatureEffect,
)
from service.estimation.fitting.dome_model import (
    SAMPLE_DELAY_SIGMA_S,
    TERMS_MAX,
    DomeModel,
    FittedEffects,
)
from service.estimation.fitting.output_error import CorrectionMisfits, DomeFit, OutputErrorProblem
from service.estimation.fitting.rig.indentation import LoadingPoints
from service.estimation.fitting.thermal_soak import list_parameters_at_bound
from service.estimation.models.hysteresis import WIDTHS_N

_SIGNIFICANT_SIGMAS = 5.0
"""Distance from zero, in standard uncertainties, from which an effect needs no test."""
_P_VALUE_MAX = 0.0027
"""Significance level of the likelihood-ratio test for the others: three standard uncertainties."""
_FORCE_MIN_N = 0.1
"""Least largest force of an effect in the rig for which it is kept."""
_FAST_READINGS_MIN = 50
"""Least number of readings of holds, releases and taps that determine fast effects."""


def fit_significant_effects(
    points: LoadingPoints,
    *,
    scale_kpa: float,
    baseline_kpa: float,
    initial_curve: Floats,
    temperature_effect: TemperatureEffect | str,
    reference_delay: Parameter,
) -> Effects:
    """Fit the effects among gas, rubber and hysteresis that the recording determines.

    Args:
        points: all loadings.
        scale_kpa: end of the calibrated range.
        baseline_kpa: absolute pressure unloaded.
        initial_curve: start values of c1, c2, c3 of the curve over gauge / `scale_kpa`.
        temperature_effect: effect of the thermal soak, whose wall compliance is used; or the reason
            for none.
        reference_delay: of the reference; `late_s` of the answer contains it.
    """
    refused: dict[EffectName, str] = {}
    temperature = None
    if isinstance(temperature_effect, str):
        refused["temperature"] = refused["ambient"] = temperature_effect
    else:
        temperature = temperature_effect
    wall_per_kpa = Effects(temperature=temperature).wall_compliance_or_default_per_kpa
    static = DomeModel(initial_curve, scale_kpa, baseline_kpa, wall_per_kpa)
    problem = OutputErrorProblem(points, static)
    parts = FittedEffects(
        late_s=(reference_delay.value, float(np.hypot(SAMPLE_DELAY_SIGMA_S, reference_delay.sigma)))
    )
    if int(points.is_fast.sum()) < _FAST_READINGS_MIN:
        parts = replace(parts, late_s=None, gas=False)
        refused["gas"] = "no holds, releases or taps in the recording"
    # Tested beside the largest number of creep terms, or creep would look like flow.
    parts = replace(parts, terms=TERMS_MAX)
    fit = problem.fit(parts)
    # One at a time: without the least significant one, the others may become significant.
    while (spared := _find_least_significant(problem, parts, fit)) is not None:
        name, why, fit = spared
        parts = replace(parts, **_WITHOUT[name])
        if name != "flow":
            refused[name] = why
    if parts.terms:
        fit = _select_creep_terms(problem, parts, fit)
    misfits = problem.compute_relative_correction_misfits(fit)
    return _make_effects(fit, misfits, temperature, refused)


def _make_effects(
    fit: DomeFit,
    misfits: CorrectionMisfits,
    temperature: TemperatureEffect | None,
    refused: dict[EffectName, str],
) -> Effects:
    """Make the effects of a fit, with their uncertainty, and of the thermal soak."""
    model, sigma = fit.model, fit.sigma
    gas = rubber = hysteresis = None
    if "gamma" in sigma:
        (gamma,) = _make_parameters([model.gamma], sigma["gamma"])
        (tau_s,) = _make_parameters([model.tau_s], model.tau_s * sigma["ln_tau"])
        gas = GasEffect(gamma=gamma, tau_s=tau_s, misfit=misfits.gas)
    if "part" in sigma:
        c1, c2, c3 = model.curve.tolist()
        rubber = RubberEffect(
            part=_make_parameters(model.part, sigma["part"]),
            tau_s=_make_parameters(model.creep_s, model.creep_s * sigma["ln_creep"]),
            coefficients=(0.0, c1, c2, c3),
            covariance=tuple(map(tuple, fit.curve_covariance.tolist())),
            scatter=fit.scatter,
            misfit=misfits.rubber,
            curve_misfit_n=misfits.curve_n,
        )
    if "loop" in sigma:
        flow = None
        if "flow_part" in sigma:
            (part,) = _make_parameters([model.flow_part], sigma["flow_part"])
            (flow_n,) = _make_parameters([model.flow_n], model.flow_n * sigma["ln_flow_n"])
            (power,) = _make_parameters([model.flow_power], sigma["flow_power"])
            flow = FlowEffect(part=part, stress_n=flow_n, power=power)
        hysteresis = HysteresisEffect(part=_make_parameters(model.loop, sigma["loop"]), flow=flow)
    late_s = None
    if "late_s" in sigma:
        (late_s,) = _make_parameters([model.late_s], sigma["late_s"])
    return Effects(
        gas=gas,
        rubber=rubber,
        hysteresis=hysteresis,
        temperature=temperature,
        late_s=late_s,
        at_bound=(*fit.at_bound, *list_parameters_at_bound(temperature)),
        refused=refused,
    )


def _select_creep_terms(
    problem: OutputErrorProblem, parts: FittedEffects, full_fit: DomeFit
) -> DomeFit:
    """Return the fit with the number of creep terms that best predicts a left-out loading.

    A further term has to lower the sum of squares significantly, and the sums of squares of
    left-out loadings, in total, by more than their scatter.

    Args:
        problem: of the tile.
        parts: effects to fit.
        full_fit: fit with `TERMS_MAX` terms.
    """
    fits = [problem.fit(replace(parts, terms=n), full_fit.scatter) for n in range(1, TERMS_MAX)]
    best, *others = [*fits, full_fit]
    for more in others:
        better = best.left_out_squares - more.left_out_squares
        is_significant = _compute_p_value(problem, more, best) < _P_VALUE_MAX
        if is_significant and better.sum() > np.sqrt(len(better)) * better.std():
            best = more
    return best


def _compute_p_value(problem: OutputErrorProblem, more: DomeFit, less: DomeFit) -> float:
    """Return the p-value of the likelihood-ratio test of `more` against `less`.

    Twice the logarithm of the ratio is chi squared with the difference of their numbers of unknowns
    (Wilks 1938). Standard uncertainties would not do: time and gamma of a fast gas compensate.
    """
    better = problem.compute_pressure_and_gain_cost(
        less.model, more.scatter
    ) - problem.compute_pressure_and_gain_cost(more.model, more.scatter)
    return float(chdtrc(more.n_unknowns - less.n_unknowns, max(better, 0.0)))


_Effect = EffectName | Literal["flow"]


@dataclass(frozen=True)
class _EffectSize:
    """Size of a fitted effect: text, in standard uncertainties, and largest force."""

    words: str
    sigmas: float
    most_n: float


def _find_least_significant(
    problem: OutputErrorProblem, parts: FittedEffects, fit: DomeFit
) -> tuple[_Effect, str, DomeFit] | None:
    """Return the least significant effect, the reason to omit it, and the fit without it.

    None: all are significant.
    """
    found, greatest = None, 0.0
    for name, without in _WITHOUT.items():
        size = _measure_effect(problem, fit, name)
        if size is None or (size.sigmas > _SIGNIFICANT_SIGMAS and size.most_n > _FORCE_MIN_N):
            continue
        less = problem.fit(replace(parts, **without), fit.scatter)
        chance = _compute_p_value(problem, fit, less)
        is_significant = chance < _P_VALUE_MAX
        if chance > greatest and not (is_significant and size.most_n > _FORCE_MIN_N):
            why = f"at most {size.most_n:.2f} N" if is_significant else "not determined"
            found, greatest = (name, f"{size.words}: {why}", less), chance
    return found


def _measure_effect(problem: OutputErrorProblem, fit: DomeFit, name: _Effect) -> _EffectSize | None:
    """Compute the size of an effect; None: it was not fitted."""
    model, full_n = fit.model, problem.max_force_n
    sigma = {each: float(sigmas[0]) for each, sigmas in fit.sigma.items()}
    flows = model.flow_part / sigma["flow_part"] if "flow_part" in sigma else 0.0
    if name == "flow" and "flow_part" in sigma:
        return _EffectSize("", flows, model.flow_part * full_n)
    if name == "hysteresis" and "loop" in sigma:
        width_n = float(model.loop @ WIDTHS_N)
        words = f"half width {width_n:.2f} +- {sigma['loop_n']:.2f} N"
        most_n = width_n + model.flow_part * full_n
        return _EffectSize(words, max(flows, width_n / sigma["loop_n"]), most_n)
    if name == "rubber" and "part" in sigma:
        total = float(model.part.sum())
        words = f"creeping part {total:.3f} +- {sigma['part_sum']:.3f}"
        return _EffectSize(words, total / sigma["part_sum"], total * full_n)
    if name == "gas" and "gamma" in sigma:
        words = f"gamma {model.gamma:.3f} +- {sigma['gamma']:.3f}"
        return _EffectSize(
            words, (model.gamma - 1.0) / sigma["gamma"], problem.compute_max_heat_effect_n(fit)
        )
    return None


_WITHOUT: Mapping[_Effect, Mapping[str, Any]] = {
    "flow": {"flow": False},
    "hysteresis": {"hysteresis": False, "flow": False},
    "rubber": {"terms": 0},
    "gas": {"gas": False},
}
"""Changes of `FittedEffects` that omit an effect."""


def _make_parameters(values: Iterable[float], sigmas: Floats) -> tuple[Parameter, ...]:
    return tuple(
        Parameter(value=float(value), sigma=float(sigma))
        for value, sigma in zip(values, sigmas, strict=True)
    )
