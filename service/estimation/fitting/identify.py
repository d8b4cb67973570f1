"""What a bench recording determines of a tile's gas, rubber and hysteresis."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

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
from service.estimation.fitting.model import DomeModel
from service.estimation.fitting.output_error import Fit, OutputErrorProblem
from service.estimation.fitting.press import Presses
from service.estimation.fitting.soak import bounds_of
from service.estimation.fitting.unknowns import LATE_S, TERMS_MAX, Parts
from service.estimation.models.hysteresis import WIDTHS_N

_CLEAR = 3.0
"""An effect is determined if it differs from zero by this many standard uncertainties."""
_TOLD = 2.0
"""A term of creep beside others is one by this many: less depends on it."""
_FAST_MIN = 50
"""Least number of readings of holds, releases and taps that determine fast effects."""


def identify(
    points: Presses,
    *,
    scale_kpa: float,
    baseline_kpa: float,
    first_curve: Floats,
    soaked: TemperatureEffect | str,
    delay: Parameter,
) -> Effects:
    """What of gas, rubber and hysteresis the recording determines.

    Args:
        points: all loadings.
        scale_kpa: end of the calibrated range.
        baseline_kpa: absolute pressure unloaded.
        first_curve: c1, c2, c3 of the static curve over gauge / `scale_kpa`, to begin with.
        soaked: from the soak, whose wall's give is used; or why it tells nothing.
        delay: of the reference; `late_s` of the answer has it in it.
    """
    refused: dict[EffectName, str] = {}
    temperature = None
    if isinstance(soaked, str):
        refused["temperature"] = refused["ambient"] = soaked
    else:
        temperature = soaked
    wall_per_kpa = Effects(temperature=temperature).wall_per_kpa
    static = DomeModel(first_curve, scale_kpa, baseline_kpa, wall_per_kpa)
    problem = OutputErrorProblem(points, static)
    parts = Parts(late_s=(delay.value, float(np.hypot(LATE_S, delay.sigma))))
    if int(points.fast.sum()) < _FAST_MIN:
        parts = replace(parts, late_s=None, gas=False)
        refused["gas"] = "no holds, releases or taps in the recording"
    while True:
        fit = best_creep(problem, parts) if parts.terms else problem.fit(parts)
        reasons = _undetermined(fit)
        if not reasons and parts.flow and not _flows(fit):
            parts = replace(parts, flow=False)
            continue
        if not reasons:
            break
        # One at a time: without the worst effect, the others may be determined.
        worst = next(name for name in ("gas", "hysteresis", "rubber") if name in reasons)
        refused[worst] = reasons[worst]
        parts = replace(parts, **_WITHOUT[worst])
    misfits, model, sigma = problem.misfits(fit), fit.model, fit.sigma
    gas = rubber = hysteresis = None
    if "gamma" in sigma:
        (gamma,) = _parameters([model.gamma], sigma["gamma"])
        (tau_s,) = _parameters([model.tau_s], model.tau_s * sigma["ln_tau"])
        gas = GasEffect(gamma=gamma, tau_s=tau_s, misfit=misfits.gas)
    if "part" in sigma:
        c1, c2, c3 = model.curve.tolist()
        rubber = RubberEffect(
            part=_parameters(model.part, sigma["part"]),
            tau_s=_parameters(model.creep_s, model.creep_s * sigma["ln_creep"]),
            coefficients=(0.0, c1, c2, c3),
            covariance=tuple(map(tuple, fit.curve_covariance.tolist())),
            scatter=fit.scatter,
            misfit=misfits.rubber,
            curve_misfit_n=misfits.curve_n,
        )
    if "loop" in sigma:
        flow = None
        if "flow_part" in sigma:
            (part,) = _parameters([model.flow_part], sigma["flow_part"])
            (flow_n,) = _parameters([model.flow_n], model.flow_n * sigma["ln_flow_n"])
            flow = FlowEffect(part=part, stress_n=flow_n)
        hysteresis = HysteresisEffect(part=_parameters(model.loop, sigma["loop"]), flow=flow)
    late_s = None
    if "late_s" in sigma:
        (late_s,) = _parameters([model.late_s], sigma["late_s"])
    return Effects(
        gas=gas,
        rubber=rubber,
        hysteresis=hysteresis,
        temperature=temperature,
        late_s=late_s,
        at_bound=(*fit.at_bound, *bounds_of(temperature)),
        refused=refused,
    )


def best_creep(problem: OutputErrorProblem, parts: Parts) -> Fit:
    """With as many terms of creep as foretell best a loading that was not fitted.

    A further term has to lower the squares of the loadings held out, in sum, by more than chance
    would from the one loading to the other, and none may be nothing: else there are too few
    loadings to tell it.
    """
    many = problem.fit(replace(parts, terms=TERMS_MAX))
    fits = [problem.fit(replace(parts, terms=n), many.scatter) for n in range(1, TERMS_MAX)]
    best, *others = [*fits, many]
    for more in others:
        better = best.unseen - more.unseen
        told = (more.model.part > _TOLD * more.sigma["part"]).all()
        if told and better.sum() > np.sqrt(len(better)) * better.std():
            best = more
    return best


def _undetermined(fit: Fit) -> dict[EffectName, str]:
    """Why a fitted effect cannot be told from zero."""
    model, sigmas = fit.model, fit.sigma
    reasons: dict[EffectName, str] = {}
    if "gamma" in sigmas:
        sigma = float(sigmas["gamma"][0])
        if model.gamma - 1.0 < _CLEAR * sigma:
            reasons["gas"] = f"gamma {model.gamma:.3f} +- {sigma:.3f}: not determined"
    if "part" in sigmas:
        total, sigma = float(model.part.sum()), float(sigmas["part_sum"][0])
        if total < _CLEAR * sigma:
            reasons["rubber"] = f"creeping part {total:.3f} +- {sigma:.3f}: not determined"
    if "loop" in sigmas and not _flows(fit):
        width_n, sigma = float(model.loop @ WIDTHS_N), float(sigmas["loop_n"][0])
        if width_n < _CLEAR * sigma:
            reasons["hysteresis"] = f"half width {width_n:.2f} +- {sigma:.2f} N: not determined"
    return reasons


def _flows(fit: Fit) -> bool:
    """Does the recording tell that a branch flows, and how much it bears?"""
    if "flow_part" not in fit.sigma:
        return False
    clear = fit.model.flow_part > _CLEAR * float(fit.sigma["flow_part"][0])
    return clear and float(fit.sigma["ln_flow_n"][0]) < 1.0 / _CLEAR


_WITHOUT: Mapping[EffectName, Mapping[str, Any]] = {
    "gas": {"gas": False},
    "hysteresis": {"hysteresis": False, "flow": False},
    "rubber": {"terms": 0},
}


def _parameters(values: Iterable[float], sigmas: Floats) -> tuple[Parameter, ...]:
    return tuple(
        Parameter(value=float(value), sigma=float(sigma))
        for value, sigma in zip(values, sigmas, strict=True)
    )
