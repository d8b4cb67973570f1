"""Mount calibration against a force plate: gains of the tiles, direction of the ground's force.

A rig loads one dome along its axis. On the foot a part of the ground's force may bypass the domes,
and the vertical part of the force through an inclined dome depends on friction: a plate measures
both, tiles do not.
"""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, model_validator

from devices.types import Identifier, Text
from service.estimation.effects import CalibrationPart, Parameter

GAIN_RANGE = (0.05, 20.0)
"""Range of gains; beyond, the unit or the tile is wrong."""
SHEAR_RANGE = (-3.0, 3.0)
"""Range of shears: friction gives -1 to 1; the rest allows for the uncertainty of a fit."""
_TILES_MAX = 256


class MountCalibration(CalibrationPart):
    """Mount calibration of a foot.

    The vertical force on the foot is the sum of `gain F (1 + shear (1 - cos a))`, with F the force
    on each tile by its rig calibration, and `a` the angle between its axis and the vertical.
    """

    against: Text
    """Session and reference."""
    gains: Annotated[dict[Identifier, Parameter], Field(min_length=1, max_length=_TILES_MAX)]
    """Gains by serial: newtons of the ground on the tile's part of the foot for one of the dome."""
    shear: Parameter | None = None
    """Direction of the ground's force. -1: along the axes of the tiles, as without friction; 1:
    vertical, and the tiles read less by the cosine. None: unknown."""

    @model_validator(mode="after")
    def _check_ranges(self) -> Self:
        least, most = GAIN_RANGE
        for serial, gain in self.gains.items():
            if not least <= gain.value <= most:
                raise ValueError(
                    f"tile {serial} has a gain of {gain.value:g}, not {least} to {most}"
                )
        if self.shear is not None and not SHEAR_RANGE[0] <= self.shear.value <= SHEAR_RANGE[1]:
            raise ValueError(f"a shear of {self.shear.value:g}, not {SHEAR_RANGE[0]} to 3")
        return self
