"""The turns of a pipelined frame: what the driver itself takes is not waited for once more."""

from __future__ import annotations

import statistics

import numpy as np

from devices.array.startup import prepare_array
from devices.buses.i2c import i2c_msg, open_bus
from devices.clock import VirtualClock
from devices.emulation.world import World
from devices.scene.scene_file import load_scene


class Slow:
    """An array of four tiles whose driver takes some time before each of its transfers."""

    def __init__(self) -> None:
        scene = load_scene("standing")
        self.clock = VirtualClock()
        self.before_ns = 0
        world = World(scene, self.clock)
        rdwr = world.i2c_adapter.i2c_rdwr

        def late(*messages: i2c_msg) -> None:
            self.clock.sleep_until_ns(self.clock.now_ns() + self.before_ns)
            rdwr(*messages)

        vars(world.i2c_adapter)["i2c_rdwr"] = late
        bus = open_bus("emulated", world.i2c_adapter)
        self.array = prepare_array(bus, scene, self.clock, schedule="pipelined").array

    def period_ns(self, frames: int = 60) -> float:
        """Of most frames: in a few a reading is asked for twice."""
        ends_ns = []
        for _ in range(frames):
            self.array.scan_frame()
            ends_ns.append(self.clock.now_ns())
        return statistics.median(np.diff(ends_ns).tolist())

    def skew_ns(self) -> int:
        """Between the first and the last tile of the next frame."""
        stops_ns = self.array.scan_frame().convert_stop_ns
        return max(stops_ns) - min(stops_ns)


def test_what_a_driver_takes_between_transfers_delays_a_frame_by_one_tiles_and_not_by_all() -> None:
    slow = Slow()
    at_once_ns = slow.period_ns()
    slow.before_ns = 30_000
    slow.period_ns()  # it finds out
    delay_ns = slow.period_ns() - at_once_ns
    transfers = 3  # of each tile: select, read, convert
    assert delay_ns <= transfers * 30_000 + 3_000
    slow.before_ns = 0
    slow.period_ns(200)
    assert abs(slow.period_ns() - at_once_ns) < 3_000


def test_tiles_that_were_read_late_once_are_soon_read_one_right_after_the_other_again() -> None:
    slow = Slow()
    slow.before_ns = 10_000
    slow.period_ns()
    before_ns = slow.skew_ns()
    slow.before_ns = 60_000
    slow.skew_ns()  # of what was converted before
    slow.before_ns = 10_000
    assert slow.skew_ns() > before_ns + 100_000
    assert min(slow.skew_ns() for _ in range(10)) < before_ns + 3_000
