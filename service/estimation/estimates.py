"""Estimates of frames, and their flags."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntFlag

import numpy as np
import numpy.typing as npt

from devices.arrays import ArrayRecord, Floats, Times

SIGMAS_95 = 1.96
"""Sigmas to each side of a 95 % interval."""


class EstimateFlag(IntFlag):
    """Bits of `Estimates.estimate_flags`, one value per frame."""

    SATURATED = 1
    """A tile is beyond its range: its force is a lower bound, and so is the GRF."""
    EXTRAPOLATED = 2
    """A tile is below its calibrated range: suction, or a tare that no longer holds."""
    OUTLIER_REPLACED = 4
    GAP = 8
    """Frames are missing before this one."""
    COP_MASKED = 16
    """No centre of pressure: no contact, or it would be too uncertain."""
    TILE_MISSING = 32
    """A tile gave no pressure, or no bare tile gave the surrounding pressure: the GRF is only a
    lower bound."""
    ASSUMED_SCALE = 64
    """The calibration's scale is assumed: newtons are not to be trusted."""
    TARE_OLD = 128
    """The tare was long ago, or at another temperature that no model corrects."""
    OVER_RATED = 256
    """A tile is above the chip's 115 kPa, but within its calibration."""
    TARE_LOST = 512
    """The tare in force is damaged on disk: all pressures and forces are unknown."""
    AFTER_SATURATION = 1024
    """The unknown load of a tile during saturation or a gap adds more to sigma than the noise of a
    reading."""
    STUCK = 2048
    """A tile repeats a count for longer than its noise allows: its force is unknown."""
    CLIPPED = 4096
    """A tile's readings end at an edge within its chip's range: its force is a lower bound."""
    BASELINE_LOST = 8192
    """A tile reads less than without a load, or has warmed or cooled and no model corrects it."""


@dataclass(frozen=True)
class Estimates(ArrayRecord):
    """Estimates of n frames; the columns of `storage.schema.ESTIMATE_COLUMNS` in float64.

    Arrays are (n,), those of tiles (n, tiles). Undefined is NaN, contact 255.
    """

    seq: npt.NDArray[np.uint64]
    t_ns: Times
    gauge_kpa: Floats
    force_n: Floats
    force_sigma_n: Floats
    grf_n: Floats
    grf_sigma_n: Floats
    grf_lower_bound_n: Floats
    cop_x_m: Floats
    cop_y_m: Floats
    cop_sigma_x_m: Floats
    cop_sigma_y_m: Floats
    cop_index_x: Floats
    cop_index_y: Floats
    cop_ground_x_m: Floats
    cop_ground_y_m: Floats
    angle_rad: Floats
    contact: npt.NDArray[np.uint8]
    estimate_flags: npt.NDArray[np.uint16]

    def __len__(self) -> int:
        return len(self.seq)
