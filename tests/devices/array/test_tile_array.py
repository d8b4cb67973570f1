"""An array of tiles: what a frame holds, when it was sampled, and what stands beside it."""

from __future__ import annotations

import pytest
from smbus2 import i2c_msg

from devices.errors import SceneError
from devices.flags import TileFlag
from devices.frames import NOT_READ
from devices.scene.hardware_sections import ScheduleName
from tests.devices.array.wiring import BIT_NS, WHOLE_NS, every_schedule
from tests.devices.rigs import (
    CONVERT,
    FOUR,
    READ,
    SCHEDULES,
    SELECT,
    TWO_MUXES,
    TYPICAL_NS,
    Wires,
    array_on,
    settled,
    settled_on,
    timed_scan,
)

READS_THE_FRAME_BEFORE = ("pipelined", "per_mux")
"""Schedules that read what the frame before has started."""


# What a frame holds


@every_schedule
def test_every_frame_is_a_fresh_conversion_of_every_tile(schedule: ScheduleName) -> None:
    array = array_on(wires := Wires(TWO_MUXES), schedule)
    first = array.scan_frame()
    last = [100 * i + 1 for i in range(4)]
    if schedule in READS_THE_FRAME_BEFORE:
        converted = [status != TileFlag.NOT_CONVERTED for status in first.tile_flags]
        # per_mux has had the tiles of the last mux convert before it came to them.
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
    assert [pressure_raw // 100 for pressure_raw in last] == [0, 1, 2, 3], "each tile's own"
    assert wires.clock.now_ns() > 0


def test_all_tiles_of_a_simultaneous_frame_convert_at_one_instant() -> None:
    wires = Wires(TWO_MUXES)
    array = array_on(wires)
    begin_ns = wires.clock.now_ns()
    # Nothing is known at first, so both muxes are selected, then comes the CONVERT.
    assert array.scan_frame().convert_stop_ns == [begin_ns + (2 * SELECT + CONVERT) * BIT_NS] * 4


def test_each_tile_of_a_sequential_frame_has_an_instant_of_its_own() -> None:
    wires, array = settled_on(FOUR, "sequential")
    first_ns = wires.clock.now_ns() + (SELECT + CONVERT) * BIT_NS
    step_ns = (SELECT + CONVERT + READ) * BIT_NS + TYPICAL_NS
    assert step_ns == 1_887_500
    assert array.scan_frame().convert_stop_ns == [first_ns + i * step_ns for i in range(4)]


@every_schedule
def test_a_sample_is_dated_by_the_stop_of_its_own_convert(schedule: ScheduleName) -> None:
    wires = Wires(TWO_MUXES)
    told: list[dict[tuple[int, int], int]] = [{} for _ in wires.tiles]
    for tile, stops_ns in zip(wires.tiles, told, strict=True):

        def note(
            stop_ns: int,
            words: tuple[int, int],
            chip: tuple[int, int, int, int],
            stops: dict[tuple[int, int], int] = stops_ns,
        ) -> None:
            stops[words] = stop_ns

        tile.on_conversion = note
    array = array_on(wires, schedule)
    array.scan_frame()
    for _ in range(20):
        scan = array.scan_frame()
        for i in range(4):
            assert scan.convert_stop_ns[i] == told[i][scan.pressure_raw[i], scan.temperature_raw[i]]


def test_the_sample_is_taken_to_lie_a_quarter_into_each_parts_own_conversion() -> None:
    array = array_on(Wires(FOUR, tc_ns=[1_600_000, 1_400_000, 2_000_000, 2_999_999]))
    assert array.sample_delay_ns == (400_000, 350_000, 500_000, 749_999)


def test_a_wait_that_is_too_short_gives_the_conversion_before() -> None:
    array = array_on(Wires(FOUR), waits_ns=[800_000] * 4)
    first, second = array.scan_frame(), array.scan_frame()
    assert first.tile_flags[0] == TileFlag.NOT_CONVERTED
    assert second.pressure_raw[0] != 2


def test_an_array_knows_its_tiles_and_which_are_behind_one_mux() -> None:
    for name in SCHEDULES:
        wires = Wires(TWO_MUXES)
        array = array_on(wires, name)
        assert array.tiles == wires.infos
        assert array.tiles_by_mux == ((0, 1), (2, 3))


def test_an_array_refuses_to_open_more_channels_than_allowed() -> None:
    with pytest.raises(SceneError, match="opens 4 channels at once"):
        array_on(Wires(FOUR), "simultaneous", broadcast_channels=3)
    with pytest.raises(SceneError, match="opens 2 channels at once"):
        array_on(Wires(TWO_MUXES), "per_mux", broadcast_channels=1)
    array_on(Wires(TWO_MUXES), "per_mux", broadcast_channels=2)
    array_on(Wires(FOUR), "pipelined", broadcast_channels=1)


# What stands beside the array


def test_what_stands_beside_is_read_once_a_frame_at_the_first_tiles_sample_instant() -> None:
    wires = Wires(FOUR)
    asked_ns: list[int] = []

    def reference_n() -> float:
        asked_ns.append(wires.clock.now_ns())
        return 0.25 * len(asked_ns)

    array = array_on(wires, reference_n=reference_n)
    for frame in range(1, 8):
        scan = array.scan_frame()
        assert scan.reference_n == 0.25 * frame
        assert len(asked_ns) == frame
        assert asked_ns[-1] == scan.convert_stop_ns[0] + 400_000 == scan.reference_ns


def test_what_stands_beside_costs_no_time_on_the_bus() -> None:
    array = settled(wires := Wires(FOUR), reference_n=lambda: 1.0)
    assert timed_scan(array, wires)[1] == WHOLE_NS


def test_without_anything_beside_there_is_no_force() -> None:
    scan = array_on(Wires(FOUR)).scan_frame()
    assert scan.reference_n != scan.reference_n  # NaN


# Temperature in every k-th frame


@every_schedule
@pytest.mark.parametrize("every", [2, 3, 10])
def test_temperature_is_read_in_every_kth_frame_and_not_known_in_between(
    schedule: ScheduleName, every: int
) -> None:
    array = array_on(Wires(FOUR), schedule, temperature_every=every)
    array.scan_frame()
    array.scan_frame()  # by now every tile has one, whatever the count of frames says
    for frame in range(2, 32):
        scan = array.scan_frame()
        assert scan.temperature_raw == [500 if frame % every == 0 else NOT_READ] * 4
        assert NOT_READ not in scan.pressure_raw
        assert scan.tile_flags == [0] * 4


def test_a_frame_without_temperature_reads_two_bytes_and_saves_18_bits_a_tile() -> None:
    array = settled(wires := Wires(FOUR), temperature_every=2)
    wires.log.clear()
    costs = [timed_scan(array, wires)[1] for _ in range(4)]
    assert (
        costs == [WHOLE_NS - 4 * 18 * BIT_NS, WHOLE_NS] * 2
        or costs
        == [
            WHOLE_NS,
            WHOLE_NS - 4 * 18 * BIT_NS,
        ]
        * 2
    )
    reads = [entry for entry in wires.log if entry.startswith("60<00")]
    assert reads.count("60<00 60>2") == reads.count("60<00 60>4") == 8


@every_schedule
def test_the_first_reading_of_a_tile_has_its_temperature(schedule: ScheduleName) -> None:
    # Without one its pressure could not be computed for up to k frames.
    array = array_on(Wires(FOUR), schedule, temperature_every=100)
    scans = [array.scan_frame() for _ in range(3)]
    for i in range(4):
        first = next(scan for scan in scans if not scan.tile_flags[i])
        assert first.temperature_raw[i] == 500


def test_a_tile_that_comes_back_brings_its_temperature() -> None:
    wires = Wires(FOUR)
    array = settled(wires, temperature_every=1000)
    with wires.fault("no_answer", "T02"):
        array.scan_frame()
    while (scan := array.scan_frame()).tile_flags[1]:
        pass
    assert scan.temperature_raw == [NOT_READ, 500, NOT_READ, NOT_READ]


# A stream begins, and goes on


@every_schedule
def test_after_something_else_used_the_bus_nothing_is_read_that_was_started_before(
    schedule: ScheduleName,
) -> None:
    wires, array = settled_on(TWO_MUXES, schedule)
    wires.bus.transfer(i2c_msg.write(0x73, [0xFF]))
    wires.clock.sleep_until_ns(wires.clock.now_ns() + 1_000_000_000)
    resumed_ns = wires.clock.now_ns()
    array.discard_bus_state()
    scan = array.scan_frame()
    for i in range(4):
        read = scan.pressure_raw[i] != NOT_READ
        assert scan.tile_flags[i] == (0 if read else TileFlag.NOT_CONVERTED)
        assert scan.convert_stop_ns[i] > resumed_ns or not read
    assert array.scan_frame().tile_flags == [0] * 4


def test_what_went_wrong_is_counted_from_the_begin_of_a_stream_and_on_when_it_goes_on() -> None:
    wires, array = settled_on(FOUR)
    with wires.fault("no_answer", "T03"):
        array.scan_frame()
    counted = dict(array.health[2].fault_counts)
    assert counted["no_answer"] == 1
    array.discard_bus_state()
    assert dict(array.health[2].fault_counts) == counted
    array.begin_stream()
    assert not array.health[2].fault_counts
