"""Loss of a baseline: by a lasting undershoot, and by leaks."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from devices.arrays import Floats
from devices.jit import jit_cached
from service.estimation.fault_detection.baseline_loss import (
    ERROR_MIN_KPA,
    LEAK_ASYMMETRY,
    TOLERANCE_SIGMAS,
    BaselineLossState,
    update_baseline_error_bound_kpa,
)
from service.estimation.records import RecordArray

RATE_HZ = 447.0
STEP_NS = round(1e9 / RATE_HZ)


def bound_error(gauge_kpa: Floats, explained_kpa: float = 0.03) -> Floats:
    out = np.empty(len(gauge_kpa))
    _update_all(BaselineLossState.array(1), gauge_kpa, (explained_kpa / TOLERANCE_SIGMAS) ** 2, out)
    return out


@jit_cached
def _update_all(
    states: RecordArray[BaselineLossState], gauge_kpa: Floats, variance: float, out: Floats
) -> None:
    for i in range(len(gauge_kpa)):
        out[i] = update_baseline_error_bound_kpa(
            states[0], LEAK_ASYMMETRY, gauge_kpa[i], variance, 0.0, STEP_NS * i
        )


def draw_noise(n: int) -> Floats:
    return 0.165 * np.random.default_rng(0).standard_normal(n)


def make_walk(steps: int, leak_s: float = np.inf) -> Floats:
    """Make half sines of 10 kPa and 0.6 s in a dome that leaks with this time constant."""
    t_s = np.arange(round(1.2 * RATE_HZ * steps)) / RATE_HZ
    squeezed = 10.0 * np.maximum(0.0, np.sin(np.pi * (t_s % 1.2) / 0.6)) * (t_s % 1.2 < 0.6)
    # Of each reading a part leaks: out = kpa - sum of all leaks before it.
    part = -np.expm1(-1.0 / (RATE_HZ * leak_s))
    return np.asarray(lfilter([1.0, -1.0], [1.0, part - 1.0], squeezed))


def test_noise_loses_no_baseline() -> None:
    assert not bound_error(draw_noise(447_000)).any()


def test_an_hour_of_walking_loses_no_baseline() -> None:
    gauge_kpa = make_walk(3000)
    assert not bound_error(gauge_kpa + draw_noise(len(gauge_kpa))).any()


def test_an_undershoot_longer_than_that_of_a_cold_gas_is_the_error_of_the_baseline() -> None:
    gauge_kpa = draw_noise(4470)
    gauge_kpa[1000:1400] -= 1.2
    lost_kpa = bound_error(gauge_kpa)
    first = int(np.flatnonzero(lost_kpa)[0])
    assert 0.35 < (first - 1000) / RATE_HZ < 0.5
    assert lost_kpa[-1] == pytest.approx(1.2, abs=0.1)  # until the next tare


def test_a_gas_cold_from_a_release_loses_no_baseline() -> None:
    # A quarter of 12 kPa, which decays in 60 ms; such a release every second.
    t_s = np.arange(44_700) / RATE_HZ
    kpa = np.where(t_s % 1.0 < 0.5, 12.0, -3.0 * np.exp(-(t_s % 1.0 - 0.5) / 0.06))
    assert not bound_error(kpa + draw_noise(len(t_s)), explained_kpa=0.0).any()


def test_an_explained_undershoot_loses_no_baseline() -> None:
    gauge_kpa = draw_noise(4470) - 1.2
    assert bound_error(gauge_kpa).any()
    assert not bound_error(gauge_kpa, explained_kpa=1.2 - ERROR_MIN_KPA / 2).any()


@pytest.mark.parametrize("leak_s", [0.1, 0.3, 1.0, 5.0, 15.0])
def test_a_leak_is_found_within_a_dozen_steps(leak_s: float) -> None:
    gauge_kpa = make_walk(20, leak_s)
    lost_kpa = bound_error(gauge_kpa + draw_noise(len(gauge_kpa)))
    assert lost_kpa.any()
    assert np.flatnonzero(lost_kpa)[0] < 12 * 1.2 * RATE_HZ
    assert lost_kpa[-1] > -0.5 * gauge_kpa.min()


def test_short_undershoots_around_a_gap_lose_no_baseline() -> None:
    gauge_kpa = draw_noise(3000)
    gauge_kpa[1000:1100] -= 1.2
    gauge_kpa[1100:1500] = np.nan
    gauge_kpa[1500:1600] -= 1.2  # 0.2 s each, a second apart
    assert not bound_error(gauge_kpa).any()
