"""A foot on an emulated bus whose frames are taken in virtual time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from devices.acquisition import Acquisition
from devices.array.schedules import BusTiming
from devices.array.self_test import identify_tiles
from devices.array.tile_array import TileArray
from devices.buses.i2c import I2cAdapter, I2cBus, open_bus
from devices.clock import UtcAnchor, VirtualClock
from devices.emulation.chips.mpl115a2 import EmulatedMpl115a2, EmulatedPart
from devices.emulation.chips.tca9548a import EmulatedTca9548a
from devices.emulation.i2c_bus import EmulatedI2cAdapter
from devices.emulation.world import World
from devices.frames import FrameBatch
from devices.scene.hardware_sections import ScheduleName, TileSection
from devices.scene.scene_file import Scene
from tests.builders.arrays import DATA_SHEET_CHIP
from tests.devices.rigs import SETTLED

ANCHOR = UtcAnchor.from_readings(0, 1_577_836_800_000_000_000, clock_set=True)
FRAME_NS = 2_532_500  # simultaneous, four tiles, 400 kHz, 1.6 ms: bus_budget.py, strategy b
TYPICAL = {"conversion_ms": 1.6, "wait_ms": 1.6}
LIVELY = {"noise_kpa": 0.06}
"""So quiet that no reading is far from those before, and not so quiet that a part seems stuck."""


@dataclass
class Foot:
    """An emulated foot and its driver."""

    world: World
    clock: VirtualClock
    array: TileArray
    stream: Acquisition

    def take(self, frames: int) -> FrameBatch:
        """So many frames, or a batch more."""
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
    wrap: Callable[[I2cAdapter], I2cAdapter] = lambda adapter: adapter,
    schedule: ScheduleName | None = None,
    start_ns: int = 3_000_000_000,
) -> Foot:
    clock = VirtualClock(start_ns)
    world = World(scene, clock, lead_s=0.0, begins_now=False)
    array = array_of(open_bus("emulated", wrap(world.i2c_adapter)), scene.tile, clock, schedule)
    for _ in range(SETTLED + 1):  # what has no history yet is read twice
        array.scan_frame()
    world.begin_scene_time()
    stream = Acquisition(array, array.tiles, clock, ANCHOR, rate_hz=rate_hz)
    return Foot(world, clock, array, stream)


def array_of(
    bus: I2cBus,
    tiles: Sequence[TileSection],
    clock: VirtualClock,
    schedule: ScheduleName | None = None,
) -> TileArray:
    found = identify_tiles(bus, tiles)
    timing = BusTiming(400_000, (1.6e-3,) * len(found), tuple(tile.mux for tile in found))
    return TileArray(bus, found, clock, schedule=schedule or "simultaneous", timing=timing)


LOOK_NS = 165_000, 215_000
"""In one frame of ten a tile is read once more before it is started, with or without a select."""


def at_its_own_pace(batch: FrameBatch, rate_hz: float) -> bool:
    """Every frame in its slot, a tenth of them later by a second look and none by more."""
    period_ns = round(1e9 / rate_hz)
    phase_ns = batch.t_mono_ns % period_ns
    phases_ns, counts = np.unique(phase_ns, return_counts=True)
    late_ns = (phase_ns - phases_ns[counts.argmax()] + period_ns // 2) % period_ns - period_ns // 2
    return bool((late_ns == 0).mean() >= 0.89 and set(late_ns.tolist()) <= {0, *LOOK_NS})


def reading(pressure_raw: int, temperature_raw: int) -> tuple[int, int, int]:
    """Counts and status of a tile of the data sheet's part that measures these words."""
    clock = VirtualClock()
    chip = EmulatedMpl115a2(
        EmulatedPart(DATA_SHEET_CHIP, 1_600_000, lambda _: (pressure_raw, temperature_raw))
    )
    adapter = EmulatedI2cAdapter([EmulatedTca9548a(0x70, {0: chip})], clock, 400_000)
    tile = TileSection(serial="T01", mux=0x70, channel=0, x_m=0.0, y_m=0.0, z_m=0.0)
    array = array_of(I2cBus(adapter, "emulated"), [tile], clock)
    frames = Acquisition(array, array.tiles, clock, ANCHOR).acquire_batches(lambda: False)
    batch = next(frames)  # its first frame: later ones are stale
    return (
        int(batch.pressure_raw[0, 0]),
        int(batch.temperature_raw[0, 0]),
        int(batch.tile_flags[0, 0]),
    )
