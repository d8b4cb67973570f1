"""What a bench recording determines of a tile's gas, rubber and hysteresis."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from devices.arrays import Floats
from service.estimation.effects import (
    EffectName,
    Effects,
    GasEffect,
    HysteresisEffect,
    Parameter,
    RubberEffect,
    TemperatureEffect,
)
from service.estimation.fitting.model import DomeModel
from service.estimation.fitting.output_error import Fit, Fitted, OutputErrorProblem
from service.estimation.fitting.press import Presses
from service.estimation.fitting.soak import bounds_of
from service.estimation.models.hysteresis import WIDTHS_N

_CLEAR = 3.0
"""An effect is determined if it differs from zero by this many standard uncertainties."""
_LN_SIGMA_MAX = 0.7
"""A time constant is determined within a factor of two."""
_FAST_MIN = 50
"""Least number of readings of holds, releases and taps that determine fast effects."""


def identify(
    points: Presses,
    *,
    scale_kpa: float,
    baseline_kpa: float,
    first_curve: Floats,
    soaked: TemperatureEffect | str,
) -> Effects:
    """What of gas, rubber and hysteresis the recording determines.

    Args:
        points: all loadings.
        scale_kpa: end of the calibrated range.
        baseline_kpa: absolute pressure unloaded.
        first_curve: c1, c2, c3 of the static curve over gauge / `scale_kpa`, to begin with.
        soaked: from the soak, whose wall's give is used; or why it tells nothing.
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
    free: frozenset[Fitted] = frozenset({"late", "gas", "rubber", "hysteresis"})
    if int(points.fast.sum()) < _FAST_MIN:
        free -= {"gas", "late"}
        refused["gas"] = "no holds, releases or taps in the recording"
    while True:
        fit = problem.fit(free)
        reasons = _undetermined(fit, free)
        if not reasons:
            break
        # One at a time: without the worst effect, the others may be determined.
        worst = next(name for name in ("gas", "hysteresis", "rubber") if name in reasons)
        refused[worst] = reasons[worst]
        free -= {worst}
    misfits, model, sigma = problem.misfits(fit), fit.model, fit.sigma
    gas = rubber = hysteresis = None
    if "gas" in free:
        (gamma,) = _parameters([model.gamma], sigma["gamma"])
        (tau_s,) = _parameters([model.tau_s], model.tau_s * sigma["ln_tau"])
        gas = GasEffect(gamma=gamma, tau_s=tau_s, misfit=misfits.gas)
    if "rubber" in free:
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
    if "hysteresis" in free:
        hysteresis = HysteresisEffect(part=_parameters(model.loop, sigma["loop"]))
    late_s = None
    if "late" in free:
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


def _undetermined(fit: Fit, free: frozenset[Fitted]) -> dict[EffectName, str]:
    """Why a fitted effect cannot be told from zero."""
    model, sigmas = fit.model, fit.sigma
    reasons: dict[EffectName, str] = {}
    if "gas" in free:
        sigma, ln_sigma = float(sigmas["gamma"][0]), float(sigmas["ln_tau"][0])
        if model.gamma - 1.0 < _CLEAR * sigma or ln_sigma > _LN_SIGMA_MAX:
            reasons["gas"] = (
                f"gamma {model.gamma:.3f} +- {sigma:.3f}, tau {model.tau_s * 1e3:.1f} ms within a "
                f"factor of {np.exp(ln_sigma):.1f}: not determined"
            )
    if "rubber" in free:
        total, sigma = float(model.part.sum()), float(sigmas["part_sum"][0])
        if total < _CLEAR * sigma:
            reasons["rubber"] = f"creeping part {total:.3f} +- {sigma:.3f}: not determined"
    if "hysteresis" in free:
        width_n, sigma = float(model.loop @ WIDTHS_N), float(sigmas["loop_n"][0])
        if width_n < _CLEAR * sigma:
            reasons["hysteresis"] = f"half width {width_n:.2f} +- {sigma:.2f} N: not determined"
    return reasons


def _parameters(values: Iterable[float], sigmas: Floats) -> tuple[Parameter, ...]:
    return tuple(
        Parameter(value=float(value), sigma=float(sigma))
        for value, sigma in zip(values, sigmas, strict=True)
    )
