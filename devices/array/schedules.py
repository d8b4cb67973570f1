"""Schedules: orders of one frame's transfers on the bus.

Each schedule is a function that scans one frame of an array into a `Scan`. `TileArray` handles and
flags faults; a schedule is only the order. `devices.array.budget` predicts the durations. At
400 kHz with four tiles of 1.6 ms: `sequential` 132 frames a second, `simultaneous` 395,
`pipelined` 544 (hardware.md 4, strategies a, b, c; `per_mux` is d).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

from devices.array.ports import Scan
from devices.scene.hardware import ScheduleName


class Transfers(Protocol):
    """Transfers of an array, for a schedule to order; implemented by `TileArray`."""

    @property
    def indices(self) -> Sequence[int]:
        """Indices of all tiles."""

    @property
    def by_mux(self) -> Sequence[Sequence[int]]:
        """Tile indices of each multiplexer."""

    def convert(self, scan: Scan, tiles: Sequence[int]) -> None:
        """Start a conversion in all these tiles at once."""

    def collect(self, scan: Scan, tile: int) -> None:
        """Read a tile's conversion as soon as it is finished."""

    def close_ranks(self) -> None:
        """Wait until all tiles can be read and restarted back to back."""


Schedule = Callable[[Transfers, Scan], None]


def sequential(array: Transfers, scan: Scan) -> None:
    """Select, convert, wait and read tile by tile: slow, and the reference for the others."""
    for tile in array.indices:
        array.convert(scan, [tile])
        array.collect(scan, tile)


def simultaneous(array: Transfers, scan: Scan) -> None:
    """Open all channels, send one CONVERT to all tiles, wait once, then read each: no skew."""
    array.convert(scan, array.indices)
    for tile in array.indices:
        array.collect(scan, tile)


def pipelined(array: Transfers, scan: Scan) -> None:
    """Read each tile's conversion of the previous frame and restart it at once.

    While one tile converts, the others are read, so that only the first tile has a wait. Tiles are
    sampled one after another; every sample has its own instant.
    """
    array.close_ranks()
    for tile in array.indices:
        array.collect(scan, tile)
        array.convert(scan, [tile])


def per_mux(array: Transfers, scan: Scan) -> None:
    """Send one CONVERT to all tiles of a mux, while the tiles of the other muxes are read.

    Before the tiles of a mux are read, the tiles of the previous mux, just read, are restarted:
    each mux converts while all the others are read.
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
