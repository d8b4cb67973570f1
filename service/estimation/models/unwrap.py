"""`unwrap`: counts that fell through zero and wrapped to near 1023, beyond the chip's range.

Real parts do this beyond some 25 N (hardware.md 1.3), and at face value full load reads as about
23 kPa. Recognised without memory: no sealed bubble can be below 50 kPa, the end of the chip's
range, so a lower reading is a count that wrapped once. A bus that reads all ones is no such case:
the driver flags it, and it never becomes a pressure.
"""

from __future__ import annotations

from devices.chips.mpl115a2 import COUNTS_MAX, PRESSURE_MIN_KPA
from devices.jit import jit_cached


@jit_cached
def unwrap_pressure(kpa: float, kpa_per_count: float) -> float:
    """Return the absolute pressure with a wrapped count corrected to below zero.

    Args:
        kpa: compensated pressure.
        kpa_per_count: pressure step of one raw pressure count (negative).

    Returns:
        Pressure in kPa; beyond every calibrated range if the count had wrapped.
    """
    return kpa - (COUNTS_MAX + 1) * kpa_per_count if kpa < PRESSURE_MIN_KPA else kpa
