"""Thermal drift: shift of the baseline by warmth that no model corrects.

Without the model `temperature` the whole shift is error, and all tiles err to the same side. The
gas follows its chip within seconds, so the larger shift counts: the chip's, or its low-pass.
"""

from __future__ import annotations

import math

import numpy as np

from devices.frames import NOT_READ
from devices.jit import jit_cached
from service.estimation.records import KernelRecord, RecordArray

SMOOTHING_S = 0.5  # long against the noise of half a count
GAS_LAG_S = 5.0  # of the gas behind its chip, at most


class ThermalDriftState(KernelRecord):
    """State of a tile: counts from the tare's, low-passed; NaN before the first reading."""

    chip_counts: float
    gas_counts: float
    t_ns: int


def initial_state(tiles: int) -> RecordArray[ThermalDriftState]:
    """Make the states before the first reading, (tiles,)."""
    return ThermalDriftState.array(tiles, chip_counts=np.nan, gas_counts=np.nan)


@jit_cached
def update_thermal_drift_kpa(
    state: ThermalDriftState,
    temperature_raw: int,
    tare_counts: float,
    kpa_per_count: float,
    t_ns: int,
) -> float:
    """Update the state; return the baseline's signed drift by warmth in kPa, 0 where unknown.

    Args:
        state: after the tile's readings before; updated.
        temperature_raw: counts; `NOT_READ` where unknown.
        tare_counts: at the tare, NaN where unknown.
        kpa_per_count: shift of the baseline for a count.
        t_ns: instant.
    """
    now = temperature_raw - tare_counts
    if temperature_raw != NOT_READ and not math.isnan(now):
        if math.isnan(state.chip_counts):
            state.chip_counts = state.gas_counts = now
        else:
            step_s = max(0.0, (t_ns - state.t_ns) * 1e-9)
            state.chip_counts += step_s / (SMOOTHING_S + step_s) * (now - state.chip_counts)
            state.gas_counts += (
                step_s / (GAS_LAG_S + step_s) * (state.chip_counts - state.gas_counts)
            )
        state.t_ns = t_ns
    more = state.chip_counts if abs(state.chip_counts) > abs(state.gas_counts) else state.gas_counts
    return 0.0 if math.isnan(more) else kpa_per_count * more
