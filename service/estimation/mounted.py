"""What a plate has shown of a mounted foot: gains of its tiles, and which way it is pushed.

A bench presses a dome along its axis, alone. On the foot a part of the ground's force may go past
the domes, and what goes through a dome that is not upright has a vertical part which depends on
friction: no tile can tell it, a plate can.
"""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, model_validator

from devices.facts import Label, Text
from service.estimation.effects import CalibrationPart, Parameter

GAIN_RANGE = (0.05, 20.0)
"""A gain beyond is none of a mount: unit or tile are wrong."""
SHEAR_RANGE = (-3.0, 3.0)
"""Between -1 and 1 is what friction can do; beyond, by as much as a fit may be uncertain."""
_TILES_MAX = 256


class Mounted(CalibrationPart):
    """A foot as it is mounted, measured against a plate.

    The vertical force on the foot is the sum of `gain F (1 + shear (1 - cos a))`, with F what the
    bench says of each tile, and `a` the angle between its axis and the vertical.
    """

    against: Text
    """The session and the reference."""
    gains: Annotated[dict[Label, Parameter], Field(min_length=1, max_length=_TILES_MAX)]
    """By serial: newtons of the ground on the tile's part of the foot for one of the dome's."""
    shear: Parameter | None = None
    """-1: the ground pushes along the axes of the tiles, as without friction; 1: straight up, and
    the tiles feel less by the cosine. None: not known."""

    @model_validator(mode="after")
    def _can_be(self) -> Self:
        least, most = GAIN_RANGE
        for serial, gain in self.gains.items():
            if not least <= gain.value <= most:
                raise ValueError(
                    f"tile {serial} has a gain of {gain.value:g}, not {least} to {most}"
                )
        if self.shear is not None and not SHEAR_RANGE[0] <= self.shear.value <= SHEAR_RANGE[1]:
            raise ValueError(f"a shear of {self.shear.value:g}, not {SHEAR_RANGE[0]} to 3")
        return self
