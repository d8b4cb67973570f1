"""The schedules: the order of one frame's transfers on the bus.

Each is one function that takes one frame of an array into a `Scan`. Whatever goes wrong in a
transfer is dealt with, and flagged, in `TileArray`; a schedule is only the order. What each costs
on the wire is in `devices.array.budget`. At 400 kHz with four tiles of 1.6 ms: `sequential` 132
frames a second, `simultaneous` 395, `pipelined` 544 (hardware.md 4, strategies a, b, c; `per_mux`
is d).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

from devices.array.ports import Scan
from devices.scene.hardware import ScheduleName


class Transfers(Protocol):
    """What a schedule puts in order: the transfers of an array, as `TileArray` does them."""

    @property
    def indices(self) -> Sequence[int]:
        """All tiles."""

    @property
    def by_mux(self) -> Sequence[Sequence[int]]:
        """Tiles of each multiplexer."""

    def convert(self, scan: Scan, tiles: Sequence[int]) -> None:
        """Start a conversion in all of these tiles at once."""

    def collect(self, scan: Scan, tile: int) -> None:
        """Read the conversion of a tile as soon as it is finished."""

    def close_ranks(self) -> None:
        """Wait until all tiles can be read and started one right after the other."""


Schedule = Callable[[Transfers, Scan], None]


def sequential(array: Transfers, scan: Scan) -> None:
    """Tile by tile: select, convert, wait, read. The slow and plain reference."""
    for tile in array.indices:
        array.convert(scan, [tile])
        array.collect(scan, tile)


def simultaneous(array: Transfers, scan: Scan) -> None:
    """Open all channels, one CONVERT for all tiles, wait once, then read each: no skew."""
    array.convert(scan, array.indices)
    for tile in array.indices:
        array.collect(scan, tile)


def pipelined(array: Transfers, scan: Scan) -> None:
    """Read what a tile has converted since the last frame, and start it again at once.

    While one tile converts, the others are served, so that the wait costs nothing but for the
    first. Tiles are sampled one after another; every tile's own instant goes with its sample.
    """
    array.close_ranks()
    for tile in array.indices:
        array.collect(scan, tile)
        array.convert(scan, [tile])


def per_mux(array: Transfers, scan: Scan) -> None:
    """One CONVERT for all tiles of a mux, while the tiles of the other muxes are read.

    Before the tiles of a mux are read, those of the mux before it, which were read last, are
    started: each mux converts while all the others are read.
    """
    for index, tiles in enumerate(array.by_mux):
        array.convert(scan, array.by_mux[index - 1])
        for tile in tiles:
            array.collect(scan, tile)


SCHEDULES: Mapping[ScheduleName, Schedule] = {
    "sequential": sequential,
    "simultaneous": simultaneous,
    "pipelined": pipelined,
    "per_mux": per_mux,
}
