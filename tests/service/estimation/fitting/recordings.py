"""Bench recordings of a tile whose parameters are known, and what is found in them.

They are made by the estimator's own forward model, unless another dome is given.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from service.estimation.effects import WALL_PER_KPA, Effects
from service.estimation.fitting.dome_model import DomeModel, compute_dome_response
from service.estimation.fitting.effects_fit import fit_determined_effects
from service.estimation.fitting.rig.indentation import Indentation
from service.estimation.fitting.static_fit import fit_static_curve
from service.estimation.models.hysteresis import WIDTHS_N

STEP_S = 0.00184
FULL_N, SCALE_KPA, BASE_KPA = 30.0, 16.0, 100.3
CURVE = np.array([22.0, 5.0, 5.0])
GAMMA, TAU_S = 1.28, 0.011
PART, CREEP_S, LOOP = (0.05, 0.04), (0.08, 1.2), (0.03, 0.04, 0.05)
FLOW_PART, FLOW_N, FLOW_POWER = 0.07, 0.35, 5.0
NOISE_KPA = 0.165


def programme(
    *, strokes: int, holds: int, taps: int, soak_s: float
) -> list[tuple[float, float, str]]:
    """What the spindle does: until when, up to which force, and what that is called."""
    steps = [(1.0, 0.0, "rest")]
    for _ in range(strokes):
        steps += [(0.3, 0.0, "rest"), (1.5, FULL_N, "load"), (1.5, 0.0, "unload")]
    for _ in range(holds):
        held_n = 0.7 * FULL_N
        steps += [(0.4, 0.0, "rest"), (0.4, held_n, "load"), (0.5, held_n, "hold")]
        steps += [(0.005, 0.0, "release")]
    steps += [(0.4, 0.0, "rest")]
    for _ in range(taps):
        steps += [(0.005, part * 0.5 * FULL_N, "tap") for part in (0.5, 1.0, 0.5, 0.0)]
        steps += [(0.1, 0.0, "rest")]
    if soak_s:
        steps += [(soak_s, 0.0, "soak")]
    ends = np.cumsum([seconds for seconds, _, _ in steps])
    return [(float(end), force, phase) for end, (_, force, phase) in zip(ends, steps, strict=True)]


def pressed_by_model(t_s: np.ndarray, force_n: np.ndarray) -> np.ndarray:
    """Pressures whose parameters are those above."""
    part, creep_s, loop = (np.array(values) for values in (PART, CREEP_S, LOOP))
    response = compute_dome_response(
        t_s, force_n, CURVE, SCALE_KPA, BASE_KPA, GAMMA, TAU_S, WALL_PER_KPA, part, creep_s, loop,
        WIDTHS_N, 0.0, 1.0, 4.0,
    )  # fmt: skip
    return response.kpa


def flowing(t_s: np.ndarray, force_n: np.ndarray) -> np.ndarray:
    """Pressures of a dome that has a branch that flows as well."""
    part, creep_s, loop = (np.array(values) for values in (PART, CREEP_S, LOOP))
    model = DomeModel(
        CURVE, SCALE_KPA, BASE_KPA, WALL_PER_KPA, GAMMA, TAU_S, part, creep_s, loop, FLOW_PART,
        FLOW_N, FLOW_POWER,
    )  # fmt: skip
    return np.asarray(model.compute_response(t_s, force_n).kpa)


def recorded(
    press: Callable[[np.ndarray, np.ndarray], np.ndarray] = pressed_by_model,
    *,
    seed: int = 0,
    scatter: float = 0.02,
    strokes: int = 4,
    holds: int = 5,
    taps: int = 15,
    soak_s: float = 0.0,
    late_s: float = 0.0,
) -> Indentation:
    """A tile pressed by the mill: white noise, and every loading with a gain of its own.

    Its chip samples so much later than the instants say.
    """
    rng = np.random.default_rng(seed)
    steps = programme(strokes=strokes, holds=holds, taps=taps, soak_s=soak_s)
    ends_s = np.array([end for end, _, _ in steps])
    t_s = np.arange(0.0, ends_s[-1], STEP_S)
    turns_s, turns_n = [0.0, *ends_s], [0.0, *(force for _, force, _ in steps)]
    force_n = np.interp(t_s, turns_s, turns_n)
    index = np.minimum(np.searchsorted(ends_s, t_s, side="right"), len(steps) - 1)
    phase = np.array([phase for _, _, phase in steps])[index]
    active = ~np.isin(phase, ("rest", "soak"))
    loading = np.cumsum(np.diff(active.astype(int), prepend=0) == 1)
    gain = 1.0 + scatter * rng.standard_normal(loading[-1] + 1)
    kpa = press(t_s, np.interp(t_s + late_s, turns_s, turns_n))
    return Indentation(
        serial="T01",
        where="here",
        t_ns=np.rint(t_s * 1e9).astype(np.int64),
        kpa=kpa[0] + gain[loading] * (kpa - kpa[0]) + rng.normal(0, NOISE_KPA, len(t_s)),
        reference_n=force_n + rng.normal(0, 0.02, len(t_s)),
        phase=phase,
        is_under_indenter=phase != "soak",
        temperature_raw=np.full(len(t_s), 498.0),
    )


def found_in(recording: Indentation) -> Effects:
    return fit_determined_effects([recording], fit_static_curve(recording))
