"""Pressure chips of an array: the kinds that a tile may have, and compensation of their counts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
from pydantic import AfterValidator

from devices.arrays import Floats
from devices.chips.bmp581 import BMP581
from devices.chips.mpl115a2 import MPL115A2
from devices.chips.pressure_chip import PressureChip, PressureLaw
from devices.errors import UsageError
from devices.flags import TileFlag
from devices.frames import NOT_READ, ArrayInfo, FrameBatch, TileInfo

PRESSURE_CHIPS: dict[str, PressureChip] = {chip.name: chip for chip in (MPL115A2, BMP581)}
"""Every kind, by its name."""


def get_chip(name: str) -> PressureChip:
    """Return a kind of chip.

    Raises:
        UsageError: there is none of this name.
    """
    if name not in PRESSURE_CHIPS:
        raise UsageError(
            f"unknown pressure chip {name!r}",
            expected=f"one of {', '.join(PRESSURE_CHIPS)}",
            remedy="Correct the name, or install the version that recorded it",
        )
    return PRESSURE_CHIPS[name]


def get_raw_type(tiles: Sequence[TileInfo]) -> np.dtype[Any]:
    """Return the type of an array's counts: its chips' widest."""
    return np.result_type(np.uint16, *{get_chip(tile.chip).raw_type for tile in tiles})


def check_chips(info: ArrayInfo) -> ArrayInfo:
    """Check that this version knows the chips of an array, and return it.

    Raises:
        UsageError: the chip of a tile is unknown, or its address or registers are not the chip's.
    """
    for tile in info.tiles:
        chip = get_chip(tile.chip)
        if tile.address not in chip.addresses:
            raise UsageError(
                f"tile {tile.serial}: a {chip.name} has no address 0x{tile.address:02x}",
                expected=", ".join(f"0x{address:02x}" for address in chip.addresses),
            )
        chip.make_law(tile.registers)
    return info


KnownArray = Annotated[ArrayInfo, AfterValidator(check_chips)]
"""Array from a file or another machine, whose chips are known."""


_QUANTIZATION_SIGMA = 1.0 / np.sqrt(12.0)  # standard deviation of the quantization error, in counts


class Compensation:
    """Laws and ranges of an array's chips, as arrays over tiles.

    Raises:
        UsageError: a tile has an unknown kind of chip.
    """

    def __init__(self, tiles: Sequence[TileInfo]) -> None:
        chips = [get_chip(tile.chip) for tile in tiles]
        laws = [chip.make_law(tile.registers) for chip, tile in zip(chips, tiles, strict=True)]
        self.law = PressureLaw(
            **{
                f.name: np.array([getattr(law, f.name) for law in laws])
                for f in fields(PressureLaw)
            }
        )
        self.min_kpa = np.array([chip.min_kpa for chip in chips])
        """Begin of each chip's rated range."""
        self.max_kpa = np.array([chip.max_kpa for chip in chips])
        """Its end."""
        self.wrap_counts = np.array([chip.wrap_counts for chip in chips])
        """Pressure counts after which readings beyond the range wrap; 0: never."""
        self.counts_per_kelvin = np.array([chip.counts_per_kelvin for chip in chips])
        self.temperature_noise_counts = np.array([chip.temperature_noise_counts for chip in chips])
        self.temperature_raw_usual = np.array([chip.temperature_raw_usual for chip in chips])

    def compute_usable_kpa(self, frames: FrameBatch) -> Floats:
        """Compute absolute pressure of frames, NaN where a tile has no usable reading."""
        unreadable = (
            ((frames.tile_flags & TileFlag.UNUSABLE) != 0)
            | (frames.pressure_raw == NOT_READ)
            | (frames.temperature_raw == NOT_READ)
        )
        kpa = self.law.compute_kpa(frames.pressure_raw, frames.temperature_raw)
        return np.where(unreadable, np.nan, kpa)

    def compute_quantization_sigma_kpa(self, temperature_raw: npt.ArrayLike) -> Floats:
        """Compute the standard uncertainty due to quantization to a count."""
        kpa_per_count = self.law.compute_kpa_per_count(temperature_raw)
        return np.asarray(np.abs(kpa_per_count) * _QUANTIZATION_SIGMA)
