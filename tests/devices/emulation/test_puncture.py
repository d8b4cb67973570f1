"""A dome with a hole: how fast its gas goes, and what is missing afterwards."""

from __future__ import annotations

import math

import pytest

from devices.emulation.fault_timing import FaultTiming
from devices.emulation.surroundings import Puncture

STEP_S = 0.001


def pressed(leak: Puncture, sealed_kpa: float, begin_s: float, seconds: float) -> float:
    """Pressure at the end of so long under a load that would give `sealed_kpa` in a whole dome."""
    steps = round(seconds / STEP_S)
    kpa = math.nan
    for i in range(1, steps + 1):
        t_s = begin_s + i * STEP_S
        kpa = leak.apply_leak(sealed_kpa, t_s, round(t_s * 1e9))
    return kpa


def test_without_the_fault_a_dome_keeps_its_gas() -> None:
    assert pressed(Puncture(FaultTiming(), 0.1, 100.0), 110.0, 0.0, 2.0) == 110.0


def test_the_pressure_difference_falls_to_1_e_in_the_time_of_the_leak() -> None:
    leak = Puncture(FaultTiming([(0.0, 100.0)]), 2.0, 100.0)
    # Of a bubble that is hardly squeezed: 2 s; one at 110 kPa has 100/110 of that time.
    assert pressed(leak, 110.0, 0.0, 2.0 / 1.1) - 100.0 == pytest.approx(10.0 / math.e, rel=1e-3)


def test_what_has_left_is_missing_when_the_load_is_gone_and_comes_back() -> None:
    leak = Puncture(FaultTiming([(0.0, 100.0)]), 0.5, 100.0)
    assert pressed(leak, 110.0, 0.0, 5.0) == pytest.approx(100.0, abs=0.01)
    assert leak.apply_leak(100.0, 5.0, 5_000_000_000) == pytest.approx(100.0 / 1.1, abs=0.01)
    assert pressed(leak, 100.0, 5.0, 5.0) == pytest.approx(100.0, abs=0.01)


def test_once_mended_it_is_sealed_with_what_it_holds() -> None:
    hole = FaultTiming([(0.0, 1.0)])
    hole.begin_scene_time(0)
    leak = Puncture(hole, 0.5, 100.0)
    held = pressed(leak, 110.0, 0.0, 0.99)
    assert held < 103.0
    assert pressed(leak, 110.0, 1.0, 5.0) == pytest.approx(held, abs=0.02)
    assert pressed(leak, 100.0, 6.0, 5.0) == pytest.approx(held / 1.1, abs=0.02)
