"""Estimates of frames, and their flags."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from devices.arrays import ArrayRecord, Floats, Times

SIGMAS_95 = 1.96
"""Sigmas to each side of a 95 % interval."""


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
