"""Counts to absolute pressure for a whole array: the data sheet's compensation per tile."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from devices.arrays import Floats
from devices.chips.mpl115a2 import Coefficients, compensate_kpa, kpa_per_padc
from devices.frames import NOT_READ, FrameBatch, TileInfo, TileStatus

_ROUNDING = 1.0 / np.sqrt(12.0)  # standard deviation of what rounding to one count takes away


class Compensation:
    """The coefficients of an array's chips, a0, b1, b2 and c12, as arrays over tiles."""

    def __init__(self, tiles: Sequence[TileInfo]) -> None:
        chips = [Coefficients.from_words(tile.coefficient_words) for tile in tiles]
        self.a0, self.b1, self.b2, self.c12 = (
            np.array([getattr(chip, name) for chip in chips]) for name in ("a0", "b1", "b2", "c12")
        )

    def kpa(self, padc: npt.ArrayLike, tadc: npt.ArrayLike) -> Floats:
        """Absolute pressure, (n, tiles), of raw counts of that shape."""
        return compensate_kpa(padc, tadc, self.a0, self.b1, self.b2, self.c12)

    def readable_kpa(self, frames: FrameBatch) -> Floats:
        """Absolute pressure of frames, NaN wherever a tile gave none."""
        unreadable = (
            ((frames.status & TileStatus.UNUSABLE) != 0)
            | (frames.padc == NOT_READ)
            | (frames.tadc == NOT_READ)
        )
        return np.where(unreadable, np.nan, self.kpa(frames.padc, frames.tadc))

    def kpa_per_count(self, tadc: npt.ArrayLike) -> Floats:
        """Pressure step of one count of `padc`; negative."""
        return kpa_per_padc(tadc, self.b1, self.c12)

    def rounding_kpa(self, tadc: npt.ArrayLike) -> Floats:
        """Standard uncertainty that rounding to a count leaves."""
        return np.asarray(np.abs(self.kpa_per_count(tadc)) * _ROUNDING)
