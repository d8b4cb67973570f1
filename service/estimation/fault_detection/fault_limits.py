"""Limits of fault detection for an array's tiles.

Before the models: counts that repeat, and clipping below the chip's end. After them: the error of
the baseline, by the corrected pressure and by warmth that no model corrects.
"""

from __future__ import annotations

import numpy as np

from devices.arrays import Bools, Floats
from devices.chips.pressure_chips import Compensation
from devices.frames import ArrayInfo
from service.estimation.calibration import Calibration
from service.estimation.fault_detection import baseline_loss
from service.estimation.fault_detection.stuck import (
    EqualCountLimits,
    StuckParams,
    make_stuck_params,
)
from service.estimation.records import KernelRecord, RecordArray
from service.estimation.tare.tare import Tare, compute_sealed_gas_shift_kpa

UNLOADED_BAND_SIGMAS = 4.0
"""Distance from the baseline within which a tile is unloaded, in sigmas of a reading."""


class FaultParams(KernelRecord):
    """Limits of a tile; the last two are of load-bearing tiles only."""

    stuck_check_max_kpa: float  # absolute pressure above which a healthy chip may stand still
    unloaded_band_kpa: float  # distance from the baseline within which it counts as unloaded
    stuck: StuckParams
    asymmetry: float  # for `baseline_loss.update_baseline_error_bound_kpa`
    thermal_kpa_per_count: float  # shift of the baseline for a raw temperature count


def make_fault_params(
    info: ArrayInfo,
    compensation: Compensation,
    calibration: Calibration,
    tare: Tare,
    chip_max_kpa: Floats,
    *,
    is_gas_corrected: Bools,
) -> tuple[RecordArray[FaultParams], RecordArray[EqualCountLimits]]:
    """Make the limits of the tiles, (tiles,), and of the array, (1,).

    Args:
        info: the array.
        compensation: of its chips.
        calibration: of its tiles.
        tare: in force.
        chip_max_kpa: (bearing tiles,), absolute pressure above which a chip saturates.
        is_gas_corrected: (bearing tiles,), whether the tile's gas is corrected.
    """
    tiles = info.tiles
    bearing = np.flatnonzero([not tile.reference for tile in tiles])
    end_kpa = np.full(len(tiles), np.inf)
    end_kpa[bearing] = chip_max_kpa
    counts = np.where(
        np.isfinite(tare.temperature_raw_counts),
        tare.temperature_raw_counts,
        compensation.temperature_raw_usual,
    )
    count_kpa = np.abs(compensation.law.compute_kpa_per_count(counts))
    # A lost tare has no noise; no tile is checked then, since no pressure is above its baseline.
    noise = np.zeros(len(tiles))
    np.divide(
        tare.noise_kpa, count_kpa, out=noise, where=(count_kpa > 0.0) & np.isfinite(tare.noise_kpa)
    )
    unloaded_kpa = UNLOADED_BAND_SIGMAS * np.hypot(tare.noise_kpa, tare.baseline_sigma_kpa)
    counts_per_kelvin = compensation.counts_per_kelvin
    per_count = compute_sealed_gas_shift_kpa(tare, 1.0 / counts_per_kelvin)[bearing]
    for at, column in enumerate(bearing):
        entry = calibration.find_tile_or_wildcard(tiles[column].serial)
        if entry is not None and entry.effects.temperature is not None:
            per_count[at] = entry.effects.temperature.kpa_per_k.value / counts_per_kelvin[column]
    stuck, limits = make_stuck_params(noise, info.nominal_rate_hz)
    made = FaultParams.array(
        len(tiles), stuck_check_max_kpa=end_kpa, unloaded_band_kpa=unloaded_kpa, stuck=stuck
    )
    made["asymmetry"][bearing] = np.where(
        is_gas_corrected, baseline_loss.LEAK_ASYMMETRY, baseline_loss.LEAK_ASYMMETRY_WITHOUT_GAS
    )
    made["thermal_kpa_per_count"][bearing] = per_count
    return made, limits
