"""What a dome gives back of the presses before its soak is no warmth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from devices.chips.mpl115a2 import TADC_PER_KELVIN
from service.estimation.effects import WALL_PER_KPA
from service.estimation.fitting.dome_model import compute_dome_response
from service.estimation.fitting.effects_fit import fit_determined_effects
from service.estimation.fitting.rig.indentation import Indentation
from service.estimation.fitting.static_fit import fit_static_curve
from service.estimation.models.hysteresis import WIDTHS_N
from tests.service.estimation.fitting.recordings import (
    BASE_KPA,
    CURVE,
    GAMMA,
    LOOP,
    SCALE_KPA,
    TAU_S,
    recorded,
)

pytestmark = pytest.mark.slow

KPA_PER_K, STEP_K, CHIP_S, GAS_S, WARM_S = 0.297, 4.0, 1.2, 3.3, 25.0


def slowly_crept(t_s: np.ndarray, force_n: np.ndarray) -> np.ndarray:
    """Pressures of a dome that creeps by 10 % within 3 s."""
    part, creep_s, loop = np.array([0.1]), np.array([3.0]), np.array(LOOP)
    response = compute_dome_response(
        t_s, force_n, CURVE, SCALE_KPA, BASE_KPA, GAMMA, TAU_S, WALL_PER_KPA, part, creep_s, loop,
        WIDTHS_N, 0.0, 1.0, 4.0,
    )  # fmt: skip
    return response.kpa


def soaked(seed: int) -> Indentation:
    """On the bench, and warmed up in the last seconds of its soak."""
    recording = recorded(slowly_crept, seed=seed, scatter=0.01, soak_s=6.5 + WARM_S)
    t_s = recording.t_ns * 1e-9
    since = np.maximum(t_s - t_s[-1] + WARM_S, 0.0)
    a, b = np.exp(-since / CHIP_S), np.exp(-since / GAS_S)
    gas_k = STEP_K * (1 - (GAS_S * b - CHIP_S * a) / (GAS_S - CHIP_S))
    noise = np.random.default_rng(seed).normal(0, 0.5, len(t_s))
    temperature_raw = np.rint(498.0 + TADC_PER_KELVIN * STEP_K * (1 - a) + noise)
    return replace(
        recording, kpa=recording.kpa + KPA_PER_K * gas_k, temperature_raw=temperature_raw
    )


def test_a_dome_that_creeps_back_in_its_soak_follows_warmth_as_much_as_any_other() -> None:
    for seed in range(2):
        recording = soaked(seed)
        warmth = fit_determined_effects([recording], fit_static_curve(recording)).temperature
        assert warmth is not None
        low, high = warmth.kpa_per_k.interval_95
        assert low < KPA_PER_K < high
        assert warmth.kpa_per_k.value == pytest.approx(KPA_PER_K, rel=0.015)
        assert warmth.wall_per_kpa.value == pytest.approx(WALL_PER_KPA, abs=0.0004)
