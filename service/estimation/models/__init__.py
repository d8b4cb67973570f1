"""Models of disturbances, one module each (`hysteresis`: two): effect on readings, and correction.

Each declares its parameters of a tile in one record, and makes them from calibration and tare.
`unwrap` is with the conversion of counts, in `service.estimation.pipeline.sample_stage`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from devices.arrays import Floats
from service.estimation.calibration import TileCalibration
from service.estimation.effects import EffectName
from service.estimation.records import KernelRecord, RecordArray


@dataclass(frozen=True)
class LoadBearingTiles:
    """Load-bearing tiles of an array, from which models make their parameters; arrays (tiles,).

    Attributes:
        calibrations: of the tiles.
        calibration_label: name and id of the calibration, for errors.
        models: names of the models in use.
        baseline_kpa: absolute pressure at the tare.
        tare_counts: mean raw temperature at the tare.
        counts_per_kelvin: temperature counts of the chips per kelvin.
        temperature_noise_counts: standard deviation of their temperature readings.
        rated_max_kpa: end of the chips' rated range.
        step_s: nominal time between two readings.
        has_bare_tile: whether the array has a bare reference tile, too.
    """

    calibrations: Sequence[TileCalibration]
    calibration_label: str
    models: Sequence[str]
    baseline_kpa: Floats
    tare_counts: Floats
    counts_per_kelvin: Floats
    temperature_noise_counts: Floats
    rated_max_kpa: Floats
    step_s: float
    has_bare_tile: bool

    @property
    def wall_per_kpa(self) -> Floats:
        """Compliance of each tile's wall, part of the volume for a kPa."""
        return np.array([e.effects.wall_compliance_or_default_per_kpa for e in self.calibrations])


class ModelParams(KernelRecord):
    """Parameters of a model for a tile; all but `is_used` are of load-bearing tiles only."""

    effect: ClassVar[EffectName | None] = None
    """Effect of a calibration that determines the parameters; None: there are none to determine."""
    is_needed_of_every_tile: ClassVar[bool] = False
    """True: every tile needs the effect, since the correction is as large as any load. Else a tile
    may lack it; its uncertainty then contains the missing correction."""

    is_used: int  # 1: the estimate uses the model

    @classmethod
    def make(cls, tiles: LoadBearingTiles) -> RecordArray[Self]:
        """Make the parameters of load-bearing tiles, (tiles,)."""
        return cls.array(len(tiles.calibrations))

    @classmethod
    def longest_time_constant_s(cls, params: RecordArray[Self]) -> float:
        """Return the longest time constant of the model's memory; 0 without any."""
        return 0.0
