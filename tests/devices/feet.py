"""A foot on an emulated bus, with frames acquired in virtual time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from devices.acquisition import Acquisition
from devices.array.schedules import BusTiming
from devices.array.self_test import identify_tiles
from devices.array.tile_array import TileArray
from devices.buses.i2c import I2cBus, open_bus
from devices.clock import UtcAnchor, VirtualClock
from devices.emulation.world import World
from devices.frames import FrameBatch
from devices.scene.hardware_sections import ScheduleName, TileSection
from devices.scene.scene_file import Scene
from tests.devices.rigs import SETTLED

ANCHOR = UtcAnchor.from_readings(0, 1_577_836_800_000_000_000, clock_set=True)


@dataclass
class Foot:
    """An emulated foot and its driver."""

    world: World
    clock: VirtualClock
    array: TileArray
    stream: Acquisition

    def acquire(self, **options: Any) -> Acquisition:
        """Begin another stream of this foot."""
        self.stream = Acquisition(self.array, self.array.tiles, self.clock, ANCHOR, **options)
        return self.stream

    def take(self, frames: int) -> FrameBatch:
        """Acquire so many frames, or a batch more."""
        batches: list[FrameBatch] = []
        for batch in self.stream.acquire_batches(lambda: False):
            batches.append(batch)
            if sum(map(len, batches)) >= frames:
                break
        return FrameBatch.concatenate(batches)

    def run_for(self, seconds: float) -> FrameBatch:
        return FrameBatch.concatenate(self.batches(seconds))

    def batches(self, seconds: float) -> list[FrameBatch]:
        end_ns = self.clock.now_ns() + round(seconds * 1e9)
        return list(self.stream.acquire_batches(lambda: self.clock.now_ns() >= end_ns))


def foot(
    scene: Scene,
    *,
    rate_hz: float = 0.0,
    schedule: ScheduleName = "simultaneous",
    start_ns: int = 3_000_000_000,
) -> Foot:
    clock = VirtualClock(start_ns)
    world = World(scene, clock, lead_s=0.0, begins_now=False)
    array = array_of(open_bus("emulated", world.i2c_adapter), scene.tile, clock, schedule)
    for _ in range(SETTLED + 1):  # a tile without history is read twice
        array.scan_frame()
    world.begin_scene_time()
    stream = Acquisition(array, array.tiles, clock, ANCHOR, rate_hz=rate_hz)
    return Foot(world, clock, array, stream)


def array_of(
    bus: I2cBus,
    tiles: Sequence[TileSection],
    clock: VirtualClock,
    schedule: ScheduleName = "simultaneous",
    *,
    wait_s: float = 1.6e-3,
    **options: Any,
) -> TileArray:
    """Return an array of identified tiles."""
    found = identify_tiles(bus, tiles)
    timing = BusTiming(400_000, (wait_s,) * len(found), tuple(tile.mux for tile in found))
    return TileArray(bus, found, clock, schedule=schedule, timing=timing, **options)
