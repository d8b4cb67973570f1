"""Compensation of raw counts to absolute pressure, by the data sheet, for a whole array."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from devices.arrays import Floats
from devices.chips.mpl115a2 import Coefficients, compensate_kpa, kpa_per_padc
from devices.frames import NOT_READ, FrameBatch, TileInfo, TileStatus

_ROUNDING = 1.0 / np.sqrt(12.0)  # standard deviation of the quantization error, in counts


class Compensation:
    """Coefficients a0, b1, b2 and c12 of an array's chips, as arrays over tiles."""

    def __init__(self, tiles: Sequence[TileInfo]) -> None:
        chips = [Coefficients.from_words(tile.coefficient_words) for tile in tiles]
        self.a0, self.b1, self.b2, self.c12 = (
            np.array([getattr(chip, name) for chip in chips]) for name in ("a0", "b1", "b2", "c12")
        )

    def kpa(self, padc: npt.ArrayLike, tadc: npt.ArrayLike) -> Floats:
        """Compute absolute pressure, (n, tiles), from raw counts of that shape."""
        return compensate_kpa(padc, tadc, self.a0, self.b1, self.b2, self.c12)

    def readable_kpa(self, frames: FrameBatch) -> Floats:
        """Compute absolute pressure of frames, NaN where a tile has no usable reading."""
        unreadable = (
            ((frames.status & TileStatus.UNUSABLE) != 0)
            | (frames.padc == NOT_READ)
            | (frames.tadc == NOT_READ)
        )
        return np.where(unreadable, np.nan, self.kpa(frames.padc, frames.tadc))

    def kpa_per_count(self, tadc: npt.ArrayLike) -> Floats:
        """Compute the pressure step of one count of `padc`; negative."""
        return kpa_per_padc(tadc, self.b1, self.c12)

    def rounding_kpa(self, tadc: npt.ArrayLike) -> Floats:
        """Compute the standard uncertainty due to quantization to a count."""
        return np.asarray(np.abs(self.kpa_per_count(tadc)) * _ROUNDING)
