"""What every conversion of every emulated part really gave, to judge what a driver made of it.

No driver has this. It is attached to a world after start-up and listens to its parts.
"""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from devices.compensation import Compensation
from devices.emulation.world import World
from devices.frames import NOT_READ, FrameBatch, TileInfo, TileStatus
from devices.mpl115a2 import SAMPLE_PART_OF_CONVERSION
from devices.temperature import hold_temperature

_ROUNDING_NS = 2_000  # offsets are whole microseconds
_NEIGHBOURS = 5

Bools = npt.NDArray[np.bool_]
Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Verdict:
    """Frames beside what was true, all of shape (n, tiles).

    Attributes:
        given: a reading was passed on as good.
        right: it is, word for word, that of the conversion it claims to be.
        error_kpa: by how much its pressure differs from that conversion's; from the median of
            those around it where there was no conversion. NaN where none is given.
    """

    given: Bools
    right: Bools
    error_kpa: Floats

    @property
    def wrong(self) -> Bools:
        """Readings that were passed on as good and are not what was converted."""
        return self.given & ~self.right


class Witness:
    """Listens to all parts of a world from now on."""

    def __init__(self, world: World) -> None:
        self._stops_ns: list[list[int]] = [[] for _ in world.parts]
        self._words: list[list[tuple[int, int]]] = [[] for _ in world.parts]
        for part, stops_ns, words in zip(world.parts, self._stops_ns, self._words, strict=True):

            def note(
                stop_ns: int,
                converted: tuple[int, int],
                stops_ns: list[int] = stops_ns,
                words: list[tuple[int, int]] = words,
            ) -> None:
                stops_ns.append(stop_ns)
                words.append(converted)

            part.witness = note

    def judge(self, frames: FrameBatch, tiles: tuple[TileInfo, ...]) -> Verdict:
        """Compare frames with what their conversions gave."""
        held, _ = hold_temperature(frames)
        compensation = Compensation(tiles)
        kpa = compensation.readable_kpa(held)
        true_padc, true_tadc, converted = self._truth(frames, tiles)
        true_kpa = compensation.kpa(true_padc, np.where(true_tadc > 0, true_tadc, held.tadc))
        given = ((frames.status & np.uint8(TileStatus.UNUSABLE)) == 0) & (frames.padc != NOT_READ)
        same_tadc = (frames.tadc == NOT_READ) | (frames.tadc == true_tadc)
        right = converted & (frames.padc == true_padc) & same_tadc
        return Verdict(given, right, np.where(given, np.abs(kpa - true_kpa), np.nan))

    def _truth(
        self, frames: FrameBatch, tiles: tuple[TileInfo, ...]
    ) -> tuple[Floats, Floats, Bools]:
        shape = frames.padc.shape
        padc, tadc = np.zeros(shape), np.zeros(shape)
        converted = np.zeros(shape, dtype=np.bool_)
        for i, tile in enumerate(tiles):
            delay_ns = round(tile.conversion_ms * 1e6) // SAMPLE_PART_OF_CONVERSION
            asked_ns = frames.t_mono_ns + frames.sample_offset_us[:, i] * 1000 - delay_ns
            stops_ns, words = self._stops_ns[i], self._words[i]
            for row, stop_ns in enumerate(asked_ns.tolist()):
                at = bisect_left(stops_ns, stop_ns - _ROUNDING_NS)
                if at < len(stops_ns) and stops_ns[at] <= stop_ns + _ROUNDING_NS:
                    padc[row, i], tadc[row, i] = words[at]
                    converted[row, i] = True
                elif words:
                    around = words[max(0, at - _NEIGHBOURS) : at + _NEIGHBOURS] or words[-1:]
                    padc[row, i], tadc[row, i] = np.median(np.array(around), axis=0)
        return padc, tadc, converted
