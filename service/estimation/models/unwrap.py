"""`unwrap`: a part pressed past its range, whose count fell through zero and came back near 1023.

Real parts do this beyond some 25 N (hardware.md 1.3), and at face value full load reads as about
23 kPa. It is recognised without memory: no sealed bubble can be below 50 kPa, the end of the
chip's range, so what reads lower is a count that wrapped once. A bus that reads all ones is no such
case: the driver flags it, and it never becomes a pressure.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from devices.arrays import Floats
from devices.chips.mpl115a2 import COUNTS_MAX, PRESSURE_MIN_KPA


def unwrap(kpa: Floats, kpa_per_count: npt.ArrayLike) -> Floats:
    """Absolute pressure with wrapped counts taken back below zero.

    Args:
        kpa: compensated pressure, any shape.
        kpa_per_count: pressure step of one count of `padc` (negative), broadcast to that shape.

    Returns:
        Pressure in kPa; beyond every calibrated range wherever a count had wrapped.
    """
    wrapped = kpa < PRESSURE_MIN_KPA
    return np.where(wrapped, kpa - (COUNTS_MAX + 1) * np.asarray(kpa_per_count), kpa)
