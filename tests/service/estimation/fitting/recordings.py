"""Rig recordings of a tile with known parameters, and the effects fitted to them.

They are made by the estimator's own forward model, unless another dome is given.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from devices.chips.mpl115a2 import MPL115A2
from service.estimation.effects import WALL_PER_KPA, Effects
from service.estimation.fitting.dome_model import DomeModel
from service.estimation.fitting.effects_fit import fit_determined_effects
from service.estimation.fitting.rig.indentation import Indentation
from service.estimation.fitting.static_fit import fit_static_curve

Press = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Pressures under forces at instants."""

STEP_S = 0.00184
FULL_N, SCALE_KPA, BASE_KPA = 30.0, 16.0, 100.3
CURVE = np.array([22.0, 5.0, 5.0])
GAMMA, TAU_S = 1.28, 0.011
PART, CREEP_S, LOOP = (0.05, 0.04), (0.08, 1.2), (0.03, 0.04, 0.05)
FLOW_PART, FLOW_N, FLOW_POWER = 0.07, 0.35, 5.0
NOISE_KPA = 0.165


def list_steps(
    *, strokes: int, holds: int, taps: int, soak_s: float
) -> list[tuple[float, float, str]]:
    """List the steps of the spindle: seconds, force at their end, and phase."""
    stroke = [(0.3, 0.0, "rest"), (1.5, FULL_N, "load"), (1.5, 0.0, "unload")]
    top_n = 0.7 * FULL_N
    hold = [(0.4, 0.0, "rest"), (0.4, top_n, "load"), (0.5, top_n, "hold"), (0.005, 0.0, "release")]
    tap = [(0.005, part * 0.5 * FULL_N, "tap") for part in (0.5, 1.0, 0.5, 0.0)]
    steps = [(1.0, 0.0, "rest"), *strokes * stroke, *holds * hold, (0.4, 0.0, "rest")]
    return [
        *steps,
        *taps * [*tap, (0.1, 0.0, "rest")],
        *([(soak_s, 0.0, "soak")] if soak_s else []),
    ]


def make_dome(**changes: Any) -> Press:
    """Make a dome with the parameters above, or others; return its pressures under a force."""
    part, creep_s, loop = (np.array(values) for values in (PART, CREEP_S, LOOP))
    model = DomeModel(CURVE, SCALE_KPA, BASE_KPA, WALL_PER_KPA, GAMMA, TAU_S, part, creep_s, loop)
    changed = model._replace(**changes)
    return lambda t_s, force_n: np.asarray(changed.compute_response(t_s, force_n).kpa)


def record(
    press: Press | None = None,
    *,
    seed: int = 0,
    scatter: float = 0.02,
    strokes: int = 4,
    holds: int = 5,
    taps: int = 15,
    soak_s: float = 0.0,
    late_s: float = 0.0,
) -> Indentation:
    """Record a tile on the mill, with white noise and a gain of every loading.

    Its chip samples `late_s` after the stated instants.
    """
    rng = np.random.default_rng(seed)
    steps = list_steps(strokes=strokes, holds=holds, taps=taps, soak_s=soak_s)
    ends_s = np.cumsum([seconds for seconds, _, _ in steps])
    t_s = np.arange(0.0, ends_s[-1], STEP_S)
    turns_s, turns_n = [0.0, *ends_s], [0.0, *(force for _, force, _ in steps)]
    force_n = np.interp(t_s, turns_s, turns_n)
    index = np.minimum(np.searchsorted(ends_s, t_s, side="right"), len(steps) - 1)
    phase = np.array([phase for _, _, phase in steps])[index]
    active = ~np.isin(phase, ("rest", "soak"))
    loading = np.cumsum(np.diff(active.astype(int), prepend=0) == 1)
    gain = 1.0 + scatter * rng.standard_normal(loading[-1] + 1)
    kpa = (press or make_dome())(t_s, np.interp(t_s + late_s, turns_s, turns_n))
    return Indentation(
        chip=MPL115A2,
        serial="T01",
        where="here",
        t_ns=np.rint(t_s * 1e9).astype(np.int64),
        kpa=kpa[0] + gain[loading] * (kpa - kpa[0]) + rng.normal(0, NOISE_KPA, len(t_s)),
        reference_n=force_n + rng.normal(0, 0.02, len(t_s)),
        phase=phase,
        is_under_indenter=phase != "soak",
        temperature_raw=np.full(len(t_s), 498.0),
    )


def fit_effects(recording: Indentation) -> Effects:
    return fit_determined_effects([recording], fit_static_curve(recording))
