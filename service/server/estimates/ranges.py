"""Calibrated ranges of an array's tiles: end of each range, and the force there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from devices.arrays import Floats
from devices.frames import ArrayInfo
from service.estimation.calibration import Calibration, TileCalibration
from service.estimation.models.static import StaticCurves


@dataclass(frozen=True)
class TileRanges:
    """Ranges of an array's tiles; arrays are (tiles,), NaN for tiles that bear no load.

    Attributes:
        entries: calibration of each tile; None for bare ones.
        end_kpa: end of each tile's calibrated range.
        full_scale_n: force at that end.
        slope_n_per_kpa: slope near zero.
    """

    entries: tuple[TileCalibration | None, ...]
    end_kpa: Floats
    full_scale_n: Floats
    slope_n_per_kpa: Floats

    @classmethod
    def from_calibration(cls, info: ArrayInfo, calibration: Calibration) -> Self:
        """Compute ends of ranges from curves and mount gains; NaN for reference tiles.

        Raises:
            CalibrationError: a tile that bears load is not in it.
        """
        serials = info.serials
        bearing = [i for i, tile in enumerate(info.tiles) if not tile.reference]
        curves = StaticCurves(calibration.get_tiles([serials[i] for i in bearing]))
        gains = [calibration.find_mount_gain(serials[i]) for i in bearing]
        gain = np.array([1.0 if one is None else one.value for one in gains])

        def by_tile(values: Floats) -> Floats:
            of_all = np.full(len(info.tiles), np.nan)
            of_all[bearing] = values
            return of_all

        return cls(
            entries=tuple(calibration.find_tile(serial) for serial in serials),
            end_kpa=by_tile(curves.range_high_kpa),
            full_scale_n=by_tile(
                gain * curves.compute_forces(curves.range_high_kpa[None]).force_n[0]
            ),
            slope_n_per_kpa=by_tile(gain * curves.slope_at_zero_n_per_kpa),
        )
