"""When a baseline is lost: undershoot that lasts, and leaks that even out."""

from __future__ import annotations

import numpy as np
import pytest

from devices.arrays import Floats
from devices.jit import jit_cached
from service.estimation.fault_detection.baseline_loss import (
    ERROR_MIN_KPA,
    LEAK_ASYMMETRY,
    TOLERANCE_SIGMAS,
    BaselineLossState,
    initial_state,
    update_baseline_error_bound_kpa,
)
from service.estimation.records import RecordArray

RATE_HZ = 447.0
STEP_NS = round(1e9 / RATE_HZ)


def judged(gauge_kpa: Floats, explained_kpa: float = 0.03) -> Floats:
    n = len(gauge_kpa)
    out = np.empty(n)
    _judge(initial_state(1), gauge_kpa, (explained_kpa / TOLERANCE_SIGMAS) ** 2, out)
    return out


@jit_cached
def _judge(
    states: RecordArray[BaselineLossState], gauge_kpa: Floats, variance: float, out: Floats
) -> None:
    for i in range(len(gauge_kpa)):
        out[i] = update_baseline_error_bound_kpa(
            states[0], LEAK_ASYMMETRY, gauge_kpa[i], variance, 0.0, STEP_NS * i
        )


def noise(n: int) -> Floats:
    return 0.165 * np.random.default_rng(0).standard_normal(n)


def walking(steps: int, leak_s: float = np.inf) -> Floats:
    """Half sines of 10 kPa and 0.6 s, as far as a leak of this time constant keeps them."""
    t_s = np.arange(round(1.2 * RATE_HZ * steps)) / RATE_HZ
    squeezed = 10.0 * np.maximum(0.0, np.sin(np.pi * (t_s % 1.2) / 0.6)) * (t_s % 1.2 < 0.6)
    gone, out = 0.0, np.empty(len(t_s))
    for i, kpa in enumerate(squeezed):
        out[i] = kpa - gone
        gone += out[i] * -np.expm1(-1.0 / (RATE_HZ * leak_s))
    return out


def test_a_baseline_that_noise_alone_moves_is_not_lost() -> None:
    assert not judged(noise(447_000)).any()


def test_an_hour_of_walking_loses_no_baseline() -> None:
    gauge_kpa = walking(3000)
    assert not judged(gauge_kpa + noise(len(gauge_kpa))).any()


def test_reading_too_little_for_longer_than_a_gas_is_cold_is_a_baseline_lost_by_as_much() -> None:
    gauge_kpa = noise(4470)
    gauge_kpa[1000:1400] -= 1.2
    lost_kpa = judged(gauge_kpa)
    first = int(np.flatnonzero(lost_kpa)[0])
    assert 0.35 < (first - 1000) / RATE_HZ < 0.5
    assert lost_kpa[-1] == pytest.approx(1.2, abs=0.1)  # until the next tare


def test_a_released_gas_that_is_cold_for_a_moment_loses_no_baseline() -> None:
    # A quarter of 12 kPa, gone with 60 ms; such a release every second.
    t_s = np.arange(44_700) / RATE_HZ
    held = np.where(t_s % 1.0 < 0.5, 12.0, -3.0 * np.exp(-(t_s % 1.0 - 0.5) / 0.06))
    assert not judged(held + noise(len(t_s)), explained_kpa=0.0).any()


def test_what_is_explained_is_not_lost() -> None:
    gauge_kpa = noise(4470) - 1.2
    assert judged(gauge_kpa).any()
    assert not judged(gauge_kpa, explained_kpa=1.2 - ERROR_MIN_KPA / 2).any()


@pytest.mark.parametrize("leak_s", [0.1, 0.3, 1.0, 5.0, 15.0])
def test_a_leak_is_found_within_a_dozen_steps_whatever_time_it_takes(leak_s: float) -> None:
    gauge_kpa = walking(20, leak_s)
    lost_kpa = judged(gauge_kpa + noise(len(gauge_kpa)))
    assert lost_kpa.any()
    assert np.flatnonzero(lost_kpa)[0] < 12 * 1.2 * RATE_HZ
    assert lost_kpa[-1] > -0.5 * gauge_kpa.min()


def test_a_gap_in_the_readings_says_nothing() -> None:
    gauge_kpa = noise(3000)
    gauge_kpa[1000:1100] -= 1.2
    gauge_kpa[1100:1500] = np.nan
    gauge_kpa[1500:1600] -= 1.2  # 0.2 s each, a second apart
    assert not judged(gauge_kpa).any()
