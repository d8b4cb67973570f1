"""An array of tiles: the readings of a frame, their instants, and the reference force."""

from __future__ import annotations

import math
import statistics
from functools import partial

import numpy as np
import pytest
from smbus2 import i2c_msg

from devices.array.startup import prepare_array
from devices.array.tile_array import TileArray
from devices.buses.i2c import open_bus
from devices.clock import VirtualClock
from devices.emulation.world import World
from devices.flags import TileFlag
from devices.frames import NOT_READ
from devices.scene.hardware_sections import ScheduleName
from devices.scene.scene_file import load_scene
from tests.devices.rigs import (
    FOUR,
    TWO_MUXES,
    WHOLE_NS,
    Wires,
    array_on,
    every_schedule,
    settled,
    settled_on,
    timed_scan,
)

# Readings and instants


@every_schedule
def test_every_frame_is_a_new_conversion_of_every_tile(schedule: ScheduleName) -> None:
    array = array_on(wires := Wires(TWO_MUXES), schedule)
    assert array.tiles == wires.infos
    assert array.tiles_by_mux == ((0, 1), (2, 3))
    first = array.scan_frame()
    last = [100 * i + 1 for i in range(4)]
    if schedule in ("pipelined", "per_mux"):  # which read conversions of the frame before
        converted = [flags != TileFlag.NOT_CONVERTED for flags in first.tile_flags]
        # per_mux starts the tiles of the last mux before it reads them.
        assert converted == [False, False] + [schedule == "per_mux"] * 2
        array.scan_frame()
        last = array.scan_frame().pressure_raw
    else:
        assert first.pressure_raw == last
        assert first.tile_flags == [0] * 4
    for _ in range(10):
        scan = array.scan_frame()
        last = [pressure_raw + 1 for pressure_raw in last]
        assert scan.pressure_raw == last
        assert scan.temperature_raw == [500] * 4
        assert scan.tile_flags == [0] * 4
        assert not scan.bus_fault
        assert math.isnan(scan.reference_n)
    assert [pressure_raw // 100 for pressure_raw in last] == [0, 1, 2, 3], "of each tile its own"


@every_schedule
def test_a_reading_has_the_instant_of_its_own_convert(schedule: ScheduleName) -> None:
    wires = Wires(TWO_MUXES)
    stops_ns: dict[tuple[int, tuple[int, int]], int] = {}

    def note(tile: int, stop_ns: int, counts: tuple[int, int], chip: object) -> None:
        stops_ns[tile, counts] = stop_ns

    for i, part in enumerate(wires.tiles):
        part.on_conversion = partial(note, i)
    array = array_on(wires, schedule)
    array.scan_frame()
    for _ in range(20):
        scan = array.scan_frame()
        counts = zip(scan.pressure_raw, scan.temperature_raw, strict=True)
        assert scan.convert_stop_ns == [stops_ns[reading] for reading in enumerate(counts)]


def test_a_sample_lies_a_quarter_into_the_conversion_of_its_part() -> None:
    array = array_on(Wires(FOUR, tc_ns=[1_600_000, 1_400_000, 2_000_000, 2_999_999]))
    assert array.sample_delay_ns == (400_000, 350_000, 500_000, 749_999)


def test_too_short_a_wait_gives_the_conversion_before() -> None:
    array = array_on(Wires(FOUR), waits_ns=[800_000] * 4)
    first, second = array.scan_frame(), array.scan_frame()
    assert first.tile_flags[0] == TileFlag.NOT_CONVERTED
    assert second.pressure_raw[0] != 2


# Reference force


def test_the_reference_force_is_read_once_a_frame_at_the_sample_instant_of_the_first_tile() -> None:
    wires = Wires(FOUR)
    asked_ns: list[int] = []

    def reference_n() -> float:
        asked_ns.append(wires.clock.now_ns())
        return 0.25 * len(asked_ns)

    array = array_on(wires, reference_n=reference_n)
    for frame in range(1, 8):
        scan, took_ns = timed_scan(array, wires)
        assert scan.reference_n == 0.25 * frame
        assert len(asked_ns) == frame
        assert asked_ns[-1] == scan.convert_stop_ns[0] + 400_000 == scan.reference_ns
    assert took_ns == WHOLE_NS, "it takes no time on the bus"


# Temperature in every k-th frame


@every_schedule
@pytest.mark.parametrize("every", [2, 3, 10])
def test_temperature_is_read_in_every_kth_frame_only(schedule: ScheduleName, every: int) -> None:
    array = array_on(Wires(FOUR), schedule, temperature_every=every)
    array.scan_frame()
    array.scan_frame()  # now every tile has one
    for frame in range(2, 32):
        scan = array.scan_frame()
        assert scan.temperature_raw == [500 if frame % every == 0 else NOT_READ] * 4
        assert NOT_READ not in scan.pressure_raw
        assert scan.tile_flags == [0] * 4


@every_schedule
def test_the_first_reading_of_a_tile_has_its_temperature(schedule: ScheduleName) -> None:
    # Without one its pressure could not be computed for up to k frames.
    array = array_on(Wires(FOUR), schedule, temperature_every=100)
    scans = [array.scan_frame() for _ in range(3)]
    for i in range(4):
        first = next(scan for scan in scans if not scan.tile_flags[i])
        assert first.temperature_raw[i] == 500


def test_the_first_reading_of_a_tile_that_returns_has_its_temperature() -> None:
    wires = Wires(FOUR)
    array = settled(wires, temperature_every=1000)
    with wires.fault("no_answer", "T02"):
        array.scan_frame()
    while (scan := array.scan_frame()).tile_flags[1]:
        pass
    assert scan.temperature_raw == [NOT_READ, 500, NOT_READ, NOT_READ]


# Streams


@every_schedule
def test_no_conversion_from_before_another_use_of_the_bus_is_read(schedule: ScheduleName) -> None:
    wires, array = settled_on(TWO_MUXES, schedule)
    wires.bus.transfer(i2c_msg.write(0x73, [0xFF]))
    wires.clock.sleep_until_ns(wires.clock.now_ns() + 1_000_000_000)
    resumed_ns = wires.clock.now_ns()
    array.discard_bus_state()
    scan = array.scan_frame()
    for i in range(4):
        is_read = scan.pressure_raw[i] != NOT_READ
        assert scan.tile_flags[i] == (0 if is_read else TileFlag.NOT_CONVERTED)
        assert scan.convert_stop_ns[i] > resumed_ns or not is_read
    assert array.scan_frame().tile_flags == [0] * 4


def test_faults_are_counted_from_the_beginning_of_a_stream() -> None:
    wires, array = settled_on(FOUR)
    with wires.fault("no_answer", "T03"):
        array.scan_frame()
    counted = dict(array.health[2].fault_counts)
    assert counted["no_answer"] == 1
    array.discard_bus_state()
    assert dict(array.health[2].fault_counts) == counted
    array.begin_stream()
    assert not array.health[2].fault_counts


# Turns of a pipelined frame


class SlowDriver:
    """An array of four tiles with a driver that takes `late_ns` before each transfer."""

    def __init__(self) -> None:
        scene = load_scene("standing")
        self.clock = VirtualClock()
        self.late_ns = 0
        adapter = World(scene, self.clock).i2c_adapter
        rdwr = adapter.i2c_rdwr

        def rdwr_late(*messages: i2c_msg) -> None:
            self.clock.sleep_until_ns(self.clock.now_ns() + self.late_ns)
            rdwr(*messages)

        vars(adapter)["i2c_rdwr"] = rdwr_late
        bus = open_bus("emulated", adapter)
        self.array: TileArray = prepare_array(bus, scene, self.clock, schedule="pipelined").array

    def measure_period_ns(self, frames: int = 60) -> float:
        """Return the median period, which second readings do not affect."""
        ends_ns = []
        for _ in range(frames):
            self.array.scan_frame()
            ends_ns.append(self.clock.now_ns())
        return statistics.median(np.diff(ends_ns).tolist())

    def measure_skew_ns(self) -> int:
        stops_ns = self.array.scan_frame().convert_stop_ns
        return max(stops_ns) - min(stops_ns)


def test_a_slow_driver_delays_a_frame_by_the_transfers_of_one_tile() -> None:
    slow = SlowDriver()
    without_ns = slow.measure_period_ns()
    slow.late_ns = 30_000
    slow.measure_period_ns()  # in which the array measures the delay
    transfers = 3  # of each tile: select, read, convert
    assert slow.measure_period_ns() - without_ns <= transfers * 30_000 + 3_000
    slow.late_ns = 0
    slow.measure_period_ns(200)
    assert abs(slow.measure_period_ns() - without_ns) < 3_000


def test_the_skew_after_a_late_frame_is_soon_as_before() -> None:
    slow = SlowDriver()
    slow.late_ns = 10_000
    slow.measure_period_ns()
    before_ns = slow.measure_skew_ns()
    slow.late_ns = 60_000
    slow.measure_skew_ns()  # of conversions from before
    slow.late_ns = 10_000
    assert slow.measure_skew_ns() > before_ns + 100_000
    assert min(slow.measure_skew_ns() for _ in range(10)) < before_ns + 3_000
