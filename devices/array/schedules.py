"""Schedules: orders of one frame's transfers on the bus.

Each schedule is a function that scans one frame of an array into a `Scan`. `TileArray` handles and
flags faults; a schedule is only the order. `devices.array.timing_budget` predicts the durations. At
400 kHz with four tiles of 1.6 ms: `sequential` 132 frames a second, `simultaneous` 395,
`pipelined` 544 (hardware.md 4, strategies a, b, c; `per_mux` is d).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

from devices.array.tile_io import Scan
from devices.scene.hardware_sections import ScheduleName


class Transfers(Protocol):
    """Transfers of an array, for a schedule to order; implemented by `TileArray`."""

    @property
    def tile_indices(self) -> Sequence[int]:
        """Indices of all tiles."""

    @property
    def tiles_by_mux(self) -> Sequence[Sequence[int]]:
        """Tile indices of each multiplexer."""

    def start_conversions(self, scan: Scan, tiles: Sequence[int]) -> None:
        """Start a conversion in all these tiles at once."""

    def read_conversion(self, scan: Scan, tile: int) -> None:
        """Read a tile's conversion as soon as it is finished."""

    def wait_for_back_to_back_reads(self) -> None:
        """Wait until all tiles can be read and restarted back to back."""


Schedule = Callable[[Transfers, Scan], None]


def sequential(array: Transfers, scan: Scan) -> None:
    """Select, convert, wait and read tile by tile: slow, and the reference for the others."""
    for tile in array.tile_indices:
        array.start_conversions(scan, [tile])
        array.read_conversion(scan, tile)


def simultaneous(array: Transfers, scan: Scan) -> None:
    """Open all channels, send one CONVERT to all tiles, wait once, then read each: no skew."""
    array.start_conversions(scan, array.tile_indices)
    for tile in array.tile_indices:
        array.read_conversion(scan, tile)


def pipelined(array: Transfers, scan: Scan) -> None:
    """Read each tile's conversion of the previous frame and restart it at once.

    While one tile converts, the others are read, so that only the first tile has a wait. Tiles are
    sampled one after another; every sample has its own instant.
    """
    array.wait_for_back_to_back_reads()
    for tile in array.tile_indices:
        array.read_conversion(scan, tile)
        array.start_conversions(scan, [tile])


def per_mux(array: Transfers, scan: Scan) -> None:
    """Send one CONVERT to all tiles of a mux, while the tiles of the other muxes are read.

    Before the tiles of a mux are read, the tiles of the previous mux, just read, are restarted:
    each mux converts while all the others are read.
    """
    for index, tiles in enumerate(array.tiles_by_mux):
        array.start_conversions(scan, array.tiles_by_mux[index - 1])
        for tile in tiles:
            array.read_conversion(scan, tile)


SCHEDULES: Mapping[ScheduleName, Schedule] = {
    "sequential": sequential,
    "simultaneous": simultaneous,
    "pipelined": pipelined,
    "per_mux": per_mux,
}
