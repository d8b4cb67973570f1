"""Creep that recovers in a soak is no warmth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from devices.chips.mpl115a2 import TADC_PER_KELVIN
from service.estimation.effects import WALL_PER_KPA
from service.estimation.fitting.rig.indentation import Indentation
from tests.service.estimation.fitting.recordings import fit_effects, make_dome, record

pytestmark = pytest.mark.slow

KPA_PER_K, STEP_K, CHIP_S, GAS_S, WARM_S = 0.297, 4.0, 1.2, 3.3, 25.0


def record_soak(seed: int) -> Indentation:
    """Record a dome that creeps by 10 % within 3 s, and warms up at the end of its soak."""
    creeping = make_dome(part=np.array([0.1]), creep_s=np.array([3.0]))
    recording = record(creeping, seed=seed, scatter=0.01, soak_s=6.5 + WARM_S)
    t_s = recording.t_ns * 1e-9
    since = np.maximum(t_s - t_s[-1] + WARM_S, 0.0)
    a, b = np.exp(-since / CHIP_S), np.exp(-since / GAS_S)
    gas_k = STEP_K * (1 - (GAS_S * b - CHIP_S * a) / (GAS_S - CHIP_S))
    noise = np.random.default_rng(seed).normal(0, 0.5, len(t_s))
    temperature_raw = np.rint(498.0 + TADC_PER_KELVIN * STEP_K * (1 - a) + noise)
    return replace(
        recording, kpa=recording.kpa + KPA_PER_K * gas_k, temperature_raw=temperature_raw
    )


def test_a_creeping_dome_follows_temperature_as_any_other() -> None:
    warmth = fit_effects(record_soak(0)).temperature
    assert warmth is not None
    low, high = warmth.kpa_per_k.interval_95
    assert low < KPA_PER_K < high
    assert warmth.kpa_per_k.value == pytest.approx(KPA_PER_K, rel=0.015)
    assert warmth.wall_per_kpa.value == pytest.approx(WALL_PER_KPA, abs=0.0004)
