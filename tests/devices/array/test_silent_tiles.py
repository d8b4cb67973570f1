"""A tile that falls silent, returns or is replaced: it is verified before it is believed."""

from __future__ import annotations

from itertools import pairwise

import pytest
from smbus2 import i2c_msg

from devices.flags import TileFlag
from devices.frames import NOT_READ
from devices.scene.hardware_sections import ScheduleName
from tests.builders.arrays import FORUM_CHIP
from tests.devices.rigs import (
    BIT_NS,
    COEFFICIENTS,
    FOUR,
    LOOK_FRAMES,
    NOT_ACKNOWLEDGED,
    ONE,
    READ,
    SELECT,
    TWO_MUXES,
    WHOLE_NS,
    Plugs,
    Wires,
    every_schedule,
    failing,
    full,
    scanned,
    settled_on,
    timed_scan,
)

IDENTIFY = "60<04 60>8"


@pytest.mark.parametrize("schedule", ["simultaneous", "pipelined", "per_mux"])
def test_a_silent_tile_has_one_flag(schedule: ScheduleName) -> None:
    wires, array = settled_on(TWO_MUXES, schedule)
    with wires.fault("no_answer", "T02"):
        for _ in range(20):
            assert array.scan_frame().tile_flags == [0, TileFlag.NO_ANSWER, 0, 0]


def test_a_silent_tile_is_looked_for_ever_more_rarely() -> None:
    wires, array = settled_on(FOUR)
    without_ns = WHOLE_NS - (SELECT + READ) * BIT_NS
    asked_ns = (SELECT + NOT_ACKNOWLEDGED) * BIT_NS
    looked_ms = []
    with wires.fault("no_answer", "T02"):
        assert timed_scan(array, wires)[1] == without_ns + 2 * asked_ns, "two attempts at first"
        begin_ns = wires.clock.now_ns()
        for _ in range(2000):
            wires.log.clear()
            now_ns = wires.clock.now_ns()
            _, took_ns = timed_scan(array, wires)
            if ("70<02", IDENTIFY) in pairwise(wires.log):
                looked_ms.append((now_ns - begin_ns) / 1e6)
                # (longer in some frame by the audit of the muxes)
                assert took_ns == without_ns + asked_ns or len(looked_ms) > 5
    gaps_ms = [after - before for before, after in pairwise(looked_ms)]
    assert looked_ms[0] == 0.0, "at once, for it may be back"
    assert all(after > 0.99 * before for before, after in pairwise(gaps_ms))
    # hardware.md 8: with back-off, one tile a second
    assert 1000 <= gaps_ms[-1] <= 1010
    assert len(looked_ms) < 15


@every_schedule
@pytest.mark.parametrize("plugs", [ONE, TWO_MUXES])
def test_a_tile_that_returns_is_identified_and_has_converted_before_it_is_read(
    schedule: ScheduleName, plugs: Plugs
) -> None:
    wires, array = settled_on(plugs, schedule)
    tile = len(plugs) // 3  # T02 of four
    with wires.fault("unplugged", f"T{tile + 1:02d}"):
        scan = scanned(array, 3)
        assert scan.tile_flags[tile] & TileFlag.NO_ANSWER
        assert scan.pressure_raw[tile] == NOT_READ
    wires.log.clear()
    for _ in range(100):
        scan = array.scan_frame()
        assert scan.tile_flags[tile] or scan.pressure_raw[tile] > 100 * tile
    # Its coefficients are read once, one channel at a time (hardware.md 2), before its counts.
    assert wires.log.count(IDENTIFY) == 1
    assert plugs == ONE or wires.log.index(IDENTIFY) > wires.log.index("70<20")
    assert scan.tile_flags == [0] * len(plugs)


def replace_part(wires: Wires, tile: int) -> None:
    """Replace a part by another one of other coefficients that measures the same counts."""
    part = wires.tiles[tile]._silicon
    wires.tiles[tile]._silicon = type(part)(FORUM_CHIP, part.conversion_ns, part.sample_counts)
    wires.tiles[tile].interrupt_supply()


@every_schedule
@pytest.mark.parametrize("misses_one_convert", [True, False])
def test_a_replaced_part_is_never_believed_and_then_left_alone(
    schedule: ScheduleName, misses_one_convert: bool
) -> None:
    wires, array = settled_on(TWO_MUXES, schedule)
    is_silent = False

    def fall_silent(_: int, messages: tuple[i2c_msg, ...]) -> bool:
        # From its CONVERT on (or, in a broadcast, from its first transfer alone).
        nonlocal is_silent
        alone = wires.muxes[0].connected_mask == 0b100000 and wires.muxes[1].connected_mask == 0
        if messages[0].addr != 0x60 or not alone:
            return False
        if bytes(messages[0]) == b"\x12\0" or schedule in ("simultaneous", "per_mux"):
            is_silent = True
        return is_silent

    if misses_one_convert:
        wires.on_transaction = failing(121, fall_silent)
        scanned(array, 3)
        assert is_silent
        wires.on_transaction = lambda _, __: None
    else:
        with wires.fault("no_answer", "T02"):
            array.scan_frame()
    replace_part(wires, 1)
    for _ in range(300):
        scan = array.scan_frame()
        assert scan.tile_flags[1] & TileFlag.UNUSABLE
        assert [scan.tile_flags[i] for i in (0, 2, 3)] == [0] * 3
    assert array.replaced_serials == ("T02",)
    wires.log.clear()
    array.scan_frame()
    assert "70<20" not in wires.log or IDENTIFY not in wires.log


# Second attempts


@every_schedule
@pytest.mark.parametrize(("plugs", "tile"), [(FOUR, 2), (FOUR, 0), (ONE, 0)])
def test_one_missing_acknowledge_is_repeated_within_the_frame_and_flagged(
    schedule: ScheduleName, plugs: Plugs, tile: int
) -> None:
    wires, array = settled_on(plugs, schedule)
    reads = 0

    def is_read_of_tile(_: int, messages: tuple[i2c_msg, ...]) -> bool:
        nonlocal reads
        reads += len(messages) == 2
        return reads == tile + 1 and len(messages) == 2

    for _ in range(5):  # in any turn of the tile
        while array._frame_index % LOOK_FRAMES == 0:
            array.scan_frame()  # in which a tile is read again
        last = array.scan_frame().pressure_raw
        if array._frame_index % LOOK_FRAMES == 0:
            last = array.scan_frame().pressure_raw
        reads = 0
        wires.on_transaction = failing(121, is_read_of_tile)
        scan = array.scan_frame()
        wires.on_transaction = lambda _, __: None
        assert scan.tile_flags == [TileFlag.RETRIED * (i == tile) for i in range(len(plugs))]
        assert scan.pressure_raw == [pressure_raw + 1 for pressure_raw in last]
        assert scan.budget_ns > 0, "a read that fails at once costs a few bits"
        assert not scan.bus_fault
        assert array.scan_frame().tile_flags == [0] * len(plugs)


def test_a_broadcast_without_an_acknowledge_is_repeated() -> None:
    wires, array = settled_on(FOUR)
    last = array.scan_frame().pressure_raw
    wires.log.clear()
    wires.on_transaction = failing(121, lambda count, _: count == 2)
    scan = array.scan_frame()
    assert wires.log[:4] == ["70<0f", "60<1200", "70<0f", "60<1200"]
    assert scan.tile_flags == [TileFlag.RETRIED] * 4
    assert scan.pressure_raw == [pressure_raw + 1 for pressure_raw in last]


@every_schedule
def test_a_mux_that_was_reset_costs_no_reading_of_a_tile_read_later(
    schedule: ScheduleName,
) -> None:
    wires, array = settled_on(FOUR, schedule)
    reads = 0

    def reset(_: int, messages: tuple[i2c_msg, ...]) -> None:
        nonlocal reads
        reads += len(messages) == 2
        if len(messages) == 2 and reads == 3:
            wires.muxes[0].reset()

    wires.on_transaction = reset
    # The adapter checks its muxes at every transfer only while any fault is possible.
    with wires.fault("mux_reset", "0x77"):
        scan = array.scan_frame()
    assert scan.tile_flags == [0, 0, TileFlag.RETRIED, 0]
    assert array.scan_frame().tile_flags == [0] * 4


@every_schedule
def test_a_foot_of_silent_tiles_gives_frames_at_most_once_a_millisecond(
    schedule: ScheduleName,
) -> None:
    wires, array = settled_on(FOUR, schedule)
    wires.on_transaction = failing(121, lambda _, messages: bool(messages[0].addr == 0x60))
    for _ in range(20):
        begin_ns = wires.clock.now_ns()
        scan, took_ns = timed_scan(array, wires)
        assert scan.pressure_raw == scan.temperature_raw == [NOT_READ] * 4
        assert all(flags & TileFlag.NO_ANSWER for flags in scan.tile_flags)
        assert not scan.bus_fault, "the muxes keep their masks"
        assert took_ns >= 1_000_000
        assert begin_ns - took_ns <= scan.convert_stop_ns[0] <= wires.clock.now_ns()
    wires.on_transaction = lambda _, __: None
    assert scanned(array, 200).tile_flags == [0] * 4


@every_schedule
@pytest.mark.parametrize("was_lost", [True, False])
def test_a_disturbed_select_gives_no_reading_of_another_tile_and_no_replaced_part(
    schedule: ScheduleName, was_lost: bool
) -> None:
    wires, array = settled_on(FOUR, schedule, words={3: FORUM_CHIP})
    last = array.scan_frame().pressure_raw
    if was_lost:
        with wires.fault("no_answer", "T02"):
            array.scan_frame()
    disturbed = 0

    def disturb() -> None:
        nonlocal disturbed
        if wires.log[-1] == "70<02" and not disturbed:
            disturbed += 1
            wires.adapter.i2c_rdwr(i2c_msg.write(0x70, [0b1000]))  # a bit or two flipped

    wires.after_transaction = disturb
    for _ in range(60):
        scan = array.scan_frame()
        last = [pressure_raw + 1 for pressure_raw in last]
        for i, flags in enumerate(scan.tile_flags):
            assert flags & TileFlag.UNUSABLE or scan.pressure_raw[i] // 100 == i
            # No earlier conversion; a tile that was lost has missed some.
            assert flags & TileFlag.UNUSABLE or was_lost or abs(scan.pressure_raw[i] - last[i]) <= 1
    assert disturbed
    assert array.replaced_serials == ()
    assert scan.tile_flags == [0] * 4


# The budget of second attempts


def test_a_tile_that_fails_every_first_transfer_does_not_slow_the_others_down() -> None:
    wires, array = settled_on(FOUR)
    transfers = 0

    def is_first(_: int, messages: tuple[i2c_msg, ...]) -> bool:
        nonlocal transfers
        if messages[0].addr != 0x60 or wires.muxes[0].connected_mask != 0b0010:
            return False
        transfers += 1
        return transfers == 1

    wires.on_transaction = failing(121, is_first)
    begin_ns = wires.clock.now_ns()
    scans = []
    for _ in range(100):
        transfers = 0
        scans.append(array.scan_frame())
    assert (wires.clock.now_ns() - begin_ns) / 100 <= 1.05 * WHOLE_NS
    # In one frame of ten the first is a second look at the reading before, which is not repeated.
    assert sum(scan.tile_flags[1] == TileFlag.RETRIED for scan in scans) >= 90
    assert all(scan.tile_flags[1] in (0, TileFlag.RETRIED) for scan in scans)
    assert all(scan.tile_flags[i] == 0 for scan in scans for i in (0, 2, 3))


def test_second_attempts_share_a_budget_so_that_a_storm_does_not_halve_the_rate() -> None:
    wires, array = settled_on(full(8))
    whole_ns = timed_scan(array, wires)[1]
    transfers = 0

    def is_third(_: int, messages: tuple[i2c_msg, ...]) -> bool:
        nonlocal transfers
        transfers += messages[0].addr == 0x60
        return bool(messages[0].addr == 0x60 and transfers % 3 == 0)

    wires.on_transaction = failing(121, is_third)
    for _ in range(100):
        assert timed_scan(array, wires)[1] < 1.5 * whole_ns


def test_a_lost_tile_costs_no_transfer_and_its_return_one_reading_of_its_coefficients() -> None:
    wires, array = settled_on(FOUR)
    with wires.fault("no_answer", "T03"):
        scanned(array, 3)
        wires.log.clear()
        array.scan_frame()
    assert wires.log == [
        *("70<0f", "60<1200"),
        *("70<01", "60<00 60>4", "70<02", "60<00 60>4"),
        *("70<08", "60<00 60>4"),
    ]
    wires, array = settled_on(FOUR)
    with wires.fault("no_answer", "T03"):
        array.scan_frame()
    assert timed_scan(array, wires)[1] == WHOLE_NS - (READ - COEFFICIENTS) * BIT_NS
