"""Compensation of raw counts to absolute pressure, by the data sheet, for a whole array."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from devices.arrays import Floats
from devices.chips.mpl115a2 import Coefficients, compensate_kpa, compute_kpa_per_padc
from devices.flags import TileFlag
from devices.frames import NOT_READ, FrameBatch, TileInfo

_QUANTIZATION_SIGMA = 1.0 / np.sqrt(12.0)  # standard deviation of the quantization error, in counts


class Compensation:
    """Coefficients a0, b1, b2 and c12 of an array's chips, as arrays over tiles."""

    def __init__(self, tiles: Sequence[TileInfo]) -> None:
        chips = [Coefficients.from_words(tile.coefficient_words) for tile in tiles]
        self.a0, self.b1, self.b2, self.c12 = (
            np.array([getattr(chip, name) for chip in chips]) for name in ("a0", "b1", "b2", "c12")
        )

    def compute_kpa(self, pressure_raw: npt.ArrayLike, temperature_raw: npt.ArrayLike) -> Floats:
        """Compute absolute pressure, (n, tiles), from raw counts of that shape."""
        return compensate_kpa(pressure_raw, temperature_raw, self.a0, self.b1, self.b2, self.c12)

    def compute_usable_kpa(self, frames: FrameBatch) -> Floats:
        """Compute absolute pressure of frames, NaN where a tile has no usable reading."""
        unreadable = (
            ((frames.tile_flags & TileFlag.UNUSABLE) != 0)
            | (frames.pressure_raw == NOT_READ)
            | (frames.temperature_raw == NOT_READ)
        )
        return np.where(
            unreadable, np.nan, self.compute_kpa(frames.pressure_raw, frames.temperature_raw)
        )

    def compute_kpa_per_count(self, temperature_raw: npt.ArrayLike) -> Floats:
        """Compute the pressure step of one count of `pressure_raw`; negative."""
        return compute_kpa_per_padc(temperature_raw, self.b1, self.c12)

    def compute_quantization_sigma_kpa(self, temperature_raw: npt.ArrayLike) -> Floats:
        """Compute the standard uncertainty due to quantization to a count."""
        return np.asarray(np.abs(self.compute_kpa_per_count(temperature_raw)) * _QUANTIZATION_SIGMA)
