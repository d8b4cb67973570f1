"""What every conversion of every emulated part really gave, to judge what a driver made of it.

It is attached to a world after start-up and listens to its parts; no driver can.
"""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt

from devices.arrays import Bools, Floats
from devices.chips.mpl115a2 import MPL115A2, Coefficients
from devices.chips.pressure_chips import Compensation
from devices.emulation.world import World
from devices.flags import TileFlag
from devices.frames import NOT_READ, FrameBatch, RawCounts, TileInfo, hold_temperature

_ROUNDING_NS = 2_000  # offsets are whole microseconds
_NEIGHBOURS = 5

Counts = npt.NDArray[RawCounts]


@dataclass(frozen=True)
class Verdict:
    """Frames beside what was true, all of shape (n, tiles).

    Attributes:
        given: a reading was passed on as good.
        same: the words are those of the conversion that they claim to be, given or not.
        right: given, the same, and of the part whose coefficients the array was described with.
        error_kpa: by how much its pressure differs from that conversion's; from the median of
            those around it where there was no conversion. NaN where none is given.
    """

    given: Bools
    same: Bools
    right: Bools
    error_kpa: Floats

    @property
    def wrong(self) -> Bools:
        """Readings that were passed on as good and are not what was converted."""
        return self.given & ~self.right


class Witness:
    """Listens to all parts of a world from now on."""

    def __init__(self, world: World) -> None:
        self._stops_ns: list[list[int]] = [[] for _ in world.chips]
        self._words: list[list[tuple[int, int]]] = [[] for _ in world.chips]
        self._chips: list[list[tuple[int, int, int, int]]] = [[] for _ in world.chips]
        for i, part in enumerate(world.chips):
            part.on_conversion = partial(self._note, i)

    def _note(
        self, tile: int, stop_ns: int, words: tuple[int, int], chip: tuple[int, int, int, int]
    ) -> None:
        self._stops_ns[tile].append(stop_ns)
        self._words[tile].append(words)
        self._chips[tile].append(chip)

    def judge(self, frames: FrameBatch, tiles: tuple[TileInfo, ...]) -> Verdict:
        """Compare frames with what their conversions gave."""
        held, _ = hold_temperature(frames)
        compensation = Compensation(tiles)
        kpa = compensation.compute_usable_kpa(held)
        true_kpa, true_padc, true_tadc, own = self._truth(frames, tiles, held.temperature_raw)
        given = ((frames.tile_flags & np.uint8(TileFlag.UNUSABLE)) == 0) & (
            frames.pressure_raw != NOT_READ
        )
        same_temperature_raw = (frames.temperature_raw == NOT_READ) | (
            frames.temperature_raw == true_tadc
        )
        same = (frames.pressure_raw == true_padc) & same_temperature_raw
        error_kpa = np.where(given, np.abs(kpa - true_kpa), np.nan)
        # Given, and no pressure can be made of it: that is wrong too, by an error without a number.
        right = given & same & own & np.isfinite(kpa)
        return Verdict(given, same, right, error_kpa)

    def _truth(
        self, frames: FrameBatch, tiles: tuple[TileInfo, ...], held_temperature_raw: Counts
    ) -> tuple[Floats, Floats, Floats, Bools]:
        """Pressure and words of the conversions that the frames claim to be, (n, tiles).

        By the coefficients of the part that converted; and whether these are those described.
        """
        shape = frames.pressure_raw.shape
        kpa = np.full(shape, np.nan)
        pressure_raw, temperature_raw = np.zeros(shape), np.zeros(shape)
        own = np.zeros(shape, dtype=np.bool_)
        for i, tile in enumerate(tiles):
            delay_ns = MPL115A2.compute_sample_delay_ns(
                tile.settings, round(tile.conversion_ms * 1e6)
            )
            asked_ns = frames.t_mono_ns + frames.sample_offset_us[:, i] * 1000 - delay_ns
            stops_ns, words, chips = self._stops_ns[i], self._words[i], self._chips[i]
            for row, stop_ns in enumerate(asked_ns.tolist()):
                at = bisect_left(stops_ns, stop_ns - _ROUNDING_NS)
                if at < len(stops_ns) and stops_ns[at] <= stop_ns + _ROUNDING_NS:
                    true_padc, true_tadc = words[at]
                    pressure_raw[row, i], temperature_raw[row, i] = words[at]
                    own[row, i] = chips[at] == tile.registers
                    # Without a temperature of its own the held one is as good as it gets.
                    if frames.temperature_raw[row, i] == NOT_READ:
                        true_tadc = int(held_temperature_raw[row, i])
                elif words:
                    around = words[max(0, at - _NEIGHBOURS) : at + _NEIGHBOURS] or words[-1:]
                    true_padc, true_tadc = np.median(np.array(around), axis=0)
                else:
                    continue
                chip = Coefficients.from_words(chips[min(at, len(chips) - 1)])
                kpa[row, i] = _kpa(true_padc, true_tadc, chip)
        return kpa, pressure_raw, temperature_raw, own


def _kpa(pressure_raw: float, temperature_raw: float, chip: Coefficients) -> float:
    return float(chip.make_law().compute_kpa(pressure_raw, temperature_raw))
