"""Limits of fault detection for an array's tiles.

Before the models: counts that repeat, and clipping below the chip's end. After them: the error of
the baseline, by the corrected pressure and by warmth that no model corrects.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from devices.arrays import Bools, Floats
from devices.chips.compensation import Compensation
from devices.chips.mpl115a2 import TADC_PER_KELVIN
from devices.frames import ArrayInfo
from service.estimation.calibration import Calibration
from service.estimation.tare.tare import Tare, expected_shift_kpa
from service.estimation.watch import baseline, repeats

UNLOADED_SIGMAS = 4.0
"""Distance from the baseline within which a tile is unloaded, in sigmas of a reading."""


@dataclass(frozen=True)
class Watch:
    """Limits over an array's tiles; the last two over load-bearing tiles only.

    Attributes:
        end_kpa: absolute pressure above which a healthy chip may stand still.
        unloaded_kpa: distance from the baseline within which a tile counts as unloaded.
        most: limits of equal counts in a row.
        even: asymmetry for `baseline_loss.lost`.
        kpa_per_count: shift of the baseline for a raw temperature count; None if a model
            corrects it.
    """

    end_kpa: Floats
    unloaded_kpa: Floats
    most: repeats.Limits
    even: Floats
    kpa_per_count: Floats | None


def make_watch(
    info: ArrayInfo,
    calibration: Calibration,
    tare: Tare,
    chip_end_kpa: Floats,
    *,
    gas_known: Bools,
    warms: bool,
) -> Watch:
    """Compute the limits.

    Args:
        info: the array.
        calibration: of its tiles.
        tare: in force.
        chip_end_kpa: (bearing tiles,), absolute pressure above which a chip saturates.
        gas_known: (bearing tiles,), whether the tile's gas is corrected.
        warms: whether no model corrects the temperature.
    """
    tiles = info.tiles
    bearing = np.flatnonzero([not tile.reference for tile in tiles])
    end_kpa = np.full(len(tiles), np.inf)
    end_kpa[bearing] = chip_end_kpa
    counts = np.where(np.isfinite(tare.tadc_counts), tare.tadc_counts, 500.0)
    count_kpa = np.abs(Compensation(tiles).kpa_per_count(counts))
    # A lost tare has no noise; no tile is checked then, since no pressure is above its baseline.
    noise = np.zeros(len(tiles))
    np.divide(
        tare.noise_kpa, count_kpa, out=noise, where=(count_kpa > 0.0) & np.isfinite(tare.noise_kpa)
    )
    unloaded_kpa = UNLOADED_SIGMAS * np.hypot(tare.noise_kpa, tare.baseline_sigma_kpa)
    per_count = expected_shift_kpa(tare, np.ones(len(tiles)) / TADC_PER_KELVIN)[bearing]
    for at, column in enumerate(bearing):
        entry = calibration.find(tiles[column].serial)
        if entry is not None and entry.effects.temperature is not None:
            per_count[at] = entry.effects.temperature.kpa_per_k.value / TADC_PER_KELVIN
    return Watch(
        end_kpa=end_kpa,
        unloaded_kpa=unloaded_kpa,
        most=repeats.make_limits(noise, info.nominal_rate_hz),
        even=np.where(gas_known, baseline.EVEN, baseline.EVEN_WITHOUT_GAS),
        kpa_per_count=per_count if warms else None,
    )
