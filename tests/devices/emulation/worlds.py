"""Emulated feet that are switched on, and their readings."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from devices.array.tile_array import TileArray
from devices.buses.i2c import open_bus
from devices.clock import VirtualClock
from devices.emulation.world import World
from devices.frames import TileInfo
from devices.scene.scene_file import Scene
from tests.devices.feet import array_of
from tests.devices.rigs import Plugs

TWO: Plugs = ((0x70, 0), (0x70, 1))
EPOCH_NS = 5_000_000_000


def switched_on(scene: Scene, **options: Any) -> tuple[World, TileArray, VirtualClock]:
    """Return a world and its driver, at a time that is not zero."""
    clock = VirtualClock(EPOCH_NS)
    world = World(scene, clock, **options)
    bus = open_bus("emulated", world.i2c_adapter)
    return world, array_of(bus, scene.tile, clock, wait_s=3e-3, broadcast_channels=64), clock


def identified(scene: Scene, **options: Any) -> tuple[TileInfo, ...]:
    return switched_on(scene, **options)[1].tiles


def counts(scene: Scene, frames: int = 30, **options: Any) -> npt.NDArray[np.int64]:
    """Return `padc` and `tadc`, (frames, 2, tiles), as the driver reads them."""
    _, array, _ = switched_on(scene, **options)
    scans = [array.scan_frame() for _ in range(frames)]
    assert all(scan.tile_flags == [0] * len(scene.tile) for scan in scans)
    return np.array([(scan.pressure_raw, scan.temperature_raw) for scan in scans])


def moved_to(scene: Scene, tile: int, **changes: Any) -> Scene:
    tiles = list(scene.tile)
    tiles[tile] = tiles[tile].model_copy(update=changes)
    return scene.model_copy(update={"tile": tuple(tiles)})
