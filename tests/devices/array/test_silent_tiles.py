"""A tile that falls silent, comes back or is another: the others keep their values, and its own are
believed only when they are its own."""

from __future__ import annotations

from itertools import pairwise

import pytest
from smbus2 import i2c_msg

from devices.array.tile_array import TileArray
from devices.flags import TileFlag
from devices.frames import NOT_READ
from devices.scene.hardware_sections import ScheduleName
from tests.builders.arrays import FORUM_CHIP
from tests.devices.array.wiring import BIT_NS, WHOLE_NS, every_schedule, failing, to_tiles
from tests.devices.rigs import (
    COEFFICIENTS,
    FOUR,
    LOOK_FRAMES,
    NOT_ACKNOWLEDGED,
    ONE,
    READ,
    SELECT,
    SETTLED,
    TWO_MUXES,
    Wires,
    full,
    scanned,
    settled_on,
    timed_scan,
)


@every_schedule
def test_a_tile_that_falls_silent_leaves_the_others_their_values(schedule: ScheduleName) -> None:
    wires, array = settled_on(TWO_MUXES, schedule)
    last = array.scan_frame().pressure_raw
    with wires.fault("no_answer", "T02"):
        for _ in range(20):
            scan = array.scan_frame()
            last = [pressure_raw + 1 for pressure_raw in last]
            assert [pressure_raw for i, pressure_raw in enumerate(scan.pressure_raw) if i != 1] == [
                pressure_raw for i, pressure_raw in enumerate(last) if i != 1
            ]
            assert (scan.pressure_raw[1], scan.temperature_raw[1]) == (NOT_READ, NOT_READ)
            assert scan.tile_flags[1] & TileFlag.NO_ANSWER
            assert [status for i, status in enumerate(scan.tile_flags) if i != 1] == [0] * 3
            assert not scan.bus_fault


@pytest.mark.parametrize("schedule", ["simultaneous", "pipelined", "per_mux"])
def test_a_silent_tile_is_told_by_one_flag(schedule: ScheduleName) -> None:
    wires, array = settled_on(TWO_MUXES, schedule)
    with wires.fault("no_answer", "T02"):
        for _ in range(20):
            assert array.scan_frame().tile_flags == [0, TileFlag.NO_ANSWER, 0, 0]


def test_a_silent_tile_is_asked_twice_in_its_first_frame_and_ever_more_rarely_from_then_on() -> (
    None
):
    wires, array = settled_on(FOUR)
    without_ns = WHOLE_NS - (SELECT + READ) * BIT_NS
    asked_ns = (SELECT + NOT_ACKNOWLEDGED) * BIT_NS
    looked_ms = []
    with wires.fault("no_answer", "T02"):
        assert timed_scan(array, wires)[1] == without_ns + 2 * asked_ns
        begin_ns = wires.clock.now_ns()
        for _ in range(2000):
            wires.log.clear()
            now_ns = wires.clock.now_ns()
            _, took_ns = timed_scan(array, wires)
            if ("70<02", "60<04 60>8") in pairwise(wires.log):
                looked_ms.append((now_ns - begin_ns) / 1e6)
                # (what is more than that, in some frame, is the audit of the muxes)
                assert took_ns == without_ns + asked_ns or len(looked_ms) > 5
    gaps_ms = [after - before for before, after in pairwise(looked_ms)]
    assert looked_ms[0] == 0.0, "at once, for it may be back"
    assert all(after > 0.99 * before for before, after in pairwise(gaps_ms))
    # hardware.md 8: with back-off, one tile a second
    assert 1000 <= gaps_ms[-1] <= 1010
    assert len(looked_ms) < 15


@every_schedule
def test_a_tile_that_is_back_is_looked_at_before_it_is_believed(schedule: ScheduleName) -> None:
    wires, array = settled_on(TWO_MUXES, schedule)
    with wires.fault("unplugged", "T02"):
        scanned(array, 3)
    wires.log.clear()
    frames = 0
    while array.scan_frame().tile_flags[1]:
        frames += 1
        assert frames < 100
    # Its coefficients, one channel at a time (hardware.md 2), before its first reading.
    assert wires.log.index("60<04 60>8") > wires.log.index("70<20")
    assert sum(entry == "60<04 60>8" for entry in wires.log) == 1


@every_schedule
def test_a_tile_that_was_powered_up_anew_is_not_read_before_it_has_converted(
    schedule: ScheduleName,
) -> None:
    wires, array = settled_on(TWO_MUXES, schedule)
    with wires.fault("unplugged", "T02"):
        array.scan_frame()
        array.scan_frame()
    for _ in range(100):
        scan = array.scan_frame()
        assert scan.tile_flags[1] or scan.pressure_raw[1] > 100, "zeros are no reading"
    assert scan.tile_flags == [0] * 4


@every_schedule
def test_another_part_in_the_place_of_a_tile_is_never_believed(schedule: ScheduleName) -> None:
    wires, array = settled_on(TWO_MUXES, schedule)
    with wires.fault("no_answer", "T02"):
        array.scan_frame()
    plug_another(wires, 1)
    for _ in range(300):
        scan = array.scan_frame()
        assert scan.tile_flags[1] & TileFlag.UNUSABLE
        assert [status for i, status in enumerate(scan.tile_flags) if i != 1] == [0] * 3
    assert scan.tile_flags[1] == TileFlag.IMPLAUSIBLE
    assert array.replaced_serials == ("T02",)
    assert "another part" in array.get_warnings()["T02"]
    wires.log.clear()
    array.scan_frame()
    assert "70<20" not in wires.log or "60<04 60>8" not in wires.log, "it is left alone"


def plug_another(wires: Wires, tile: int) -> None:
    """Another part, of other coefficients, that reads the very same counts."""
    silicon = wires.tiles[tile]._silicon
    wires.tiles[tile]._silicon = type(silicon)(
        FORUM_CHIP, silicon.conversion_ns, silicon.sample_counts
    )
    wires.tiles[tile].interrupt_supply()


@every_schedule
def test_another_part_is_not_believed_even_if_only_one_convert_was_missed(
    schedule: ScheduleName,
) -> None:
    wires, array = settled_on(TWO_MUXES, schedule)
    silent = False

    def swap(_: int, messages: tuple[i2c_msg, ...]) -> None:
        # Silent from its CONVERT on (or, in a broadcast, from the first time it is alone).
        nonlocal silent
        alone = wires.muxes[0].connected_mask == 0b100000 and wires.muxes[1].connected_mask == 0
        if messages[0].addr == 0x60 and alone:
            if bytes(messages[0]) == b"\x12\0" or schedule in ("simultaneous", "per_mux"):
                silent = True
            if silent:
                raise OSError(121, "nobody there")

    wires.on_transaction = swap
    scanned(array, 3)
    assert silent
    wires.on_transaction = lambda _, __: None
    plug_another(wires, 1)
    for _ in range(300):
        assert array.scan_frame().tile_flags[1] & TileFlag.UNUSABLE
    assert array.replaced_serials == ("T02",)


@every_schedule
def test_one_missing_acknowledge_is_mended_within_the_frame_and_flagged(
    schedule: ScheduleName,
) -> None:
    wires, array = settled_on(FOUR, schedule)
    for _ in range(5):  # whatever the turn of the tile is
        mended(wires, array, 2)


@every_schedule
def test_so_it_is_if_the_tile_was_waited_for(schedule: ScheduleName) -> None:
    wires, array = settled_on(FOUR, schedule)
    for _ in range(5):
        mended(wires, array, 0)


@every_schedule
def test_so_it_is_in_an_array_of_one(schedule: ScheduleName) -> None:
    wires, array = settled_on(ONE, schedule)
    before = [array.scan_frame().pressure_raw[0] for _ in range(3)]
    wires.log.clear()
    failed: list[bool] = []

    def first_read(_: int, messages: tuple[i2c_msg, ...]) -> bool:
        if len(messages) < 2 or failed:
            return False
        failed.append(True)
        return True

    wires.on_transaction = failing(121, first_read)
    scan = array.scan_frame()
    assert scan.tile_flags == [TileFlag.RETRIED]
    assert scan.budget_ns > 0, "a read that failed at once has cost a few bits"
    assert scan.pressure_raw[0] == before[-1] + 1


def mended(wires: Wires, array: TileArray, tile: int) -> None:
    """The first read of one tile is not acknowledged: what the frame says of it."""
    if array._frame_index % LOOK_FRAMES == 0:
        array.scan_frame()  # in which somebody is read once more
    reads = 0

    def one_read(_: int, messages: tuple[i2c_msg, ...]) -> bool:
        nonlocal reads
        reads += len(messages) == 2
        return reads == tile + 1 and len(messages) == 2

    wires.on_transaction = failing(121, one_read)
    scan = array.scan_frame()
    wires.on_transaction = lambda _, __: None
    assert scan.tile_flags == [TileFlag.RETRIED if i == tile else 0 for i in range(4)]
    assert NOT_READ not in scan.pressure_raw
    assert not scan.bus_fault
    assert array.scan_frame().tile_flags == [0] * 4


def test_a_broadcast_that_nobody_acknowledged_is_tried_once_more() -> None:
    wires, array = settled_on(FOUR)
    last = array.scan_frame().pressure_raw
    wires.log.clear()
    wires.on_transaction = failing(121, lambda count, _: count == 2)
    scan = array.scan_frame()
    assert wires.log[:4] == ["70<0f", "60<1200", "70<0f", "60<1200"]
    assert scan.tile_flags == [TileFlag.RETRIED] * 4
    assert scan.pressure_raw == [pressure_raw + 1 for pressure_raw in last]


@every_schedule
def test_a_mux_that_was_reset_behind_our_back_costs_no_sample_of_a_tile_read_later(
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
    # The adapter looks at its muxes at every transfer only if something may be wrong with them.
    with wires.fault("mux_reset", "0x77"):
        scan = array.scan_frame()
    assert scan.tile_flags == [0, 0, TileFlag.RETRIED, 0]
    assert array.scan_frame().tile_flags == [0] * 4


@every_schedule
def test_a_foot_without_any_tile_left_is_still_a_frame(schedule: ScheduleName) -> None:
    wires, array = settled_on(FOUR, schedule)
    wires.on_transaction = failing(121, to_tiles)
    for _ in range(20):
        begin_ns = wires.clock.now_ns()
        scan, took_ns = timed_scan(array, wires)
        assert scan.pressure_raw == scan.temperature_raw == [NOT_READ] * 4
        assert all(status & TileFlag.NO_ANSWER for status in scan.tile_flags)
        assert not scan.bus_fault, "the muxes keep what is written to them"
        assert took_ns >= 1_000_000, "nothing to do is no reason to hurry"
        assert begin_ns - took_ns <= scan.convert_stop_ns[0] <= wires.clock.now_ns()
    wires.on_transaction = lambda _, __: None
    scan = scanned(array, 200)
    assert scan.tile_flags == [0] * 4


def test_one_disturbed_select_does_not_make_a_tile_another_part() -> None:
    wires, array = settled_on(FOUR, words={3: FORUM_CHIP})
    with wires.fault("no_answer", "T02"):
        array.scan_frame()
    disturbed: list[bool] = []

    def disturb() -> None:
        if wires.log[-1] == "70<02" and not disturbed:
            disturbed.append(True)
            wires.adapter.i2c_rdwr(i2c_msg.write(0x70, [0b1000]))  # a bit or two turned over

    wires.after_transaction = disturb
    scan = scanned(array, 100)
    assert disturbed
    assert array.replaced_serials == ()
    assert scan.tile_flags == [0] * 4


@every_schedule
def test_one_disturbed_select_passes_on_no_word_of_another_tile(schedule: ScheduleName) -> None:
    wires, array = settled_on(FOUR, schedule, words={3: FORUM_CHIP})
    last = array.scan_frame().pressure_raw
    disturbed: list[bool] = []

    def disturb() -> None:
        if wires.log[-1] == "70<02" and not disturbed:
            disturbed.append(True)
            wires.adapter.i2c_rdwr(i2c_msg.write(0x70, [0b1000]))

    wires.after_transaction = disturb
    for _ in range(20):
        scan = array.scan_frame()
        last = [pressure_raw + 1 for pressure_raw in last]
        for i in range(4):
            assert (
                scan.tile_flags[i] & TileFlag.UNUSABLE or abs(scan.pressure_raw[i] - last[i]) <= 1
            )
    assert disturbed
    assert scan.tile_flags == [0] * 4


# The budget of second attempts


def test_one_bad_plug_does_not_slow_the_others_down() -> None:
    # Every transfer of one tile fails at every second attempt: it is never quite lost.
    wires, array = settled_on(FOUR)
    bad = 0

    def first(_: int, messages: tuple[i2c_msg, ...]) -> bool:
        nonlocal bad
        if messages[0].addr != 0x60 or wires.muxes[0].connected_mask != 0b0010:
            return False
        bad += 1
        return bad == 1

    wires.on_transaction = failing(121, first)
    begin_ns = wires.clock.now_ns()
    scans = []
    for _ in range(100):
        bad = 0
        scans.append(array.scan_frame())
    assert (wires.clock.now_ns() - begin_ns) / 100 <= 1.05 * WHOLE_NS
    # In one frame of ten the first is a second look at the reading before, which is not repeated.
    retried = [scan.tile_flags[1] == TileFlag.RETRIED for scan in scans]
    assert sum(retried) >= 90
    assert all(scan.tile_flags[1] in (0, TileFlag.RETRIED) for scan in scans)
    assert all(scan.tile_flags[i] == 0 for scan in scans for i in (0, 2, 3))


def test_second_attempts_share_a_budget_so_that_a_storm_does_not_halve_the_rate() -> None:
    plugs = full(8)
    wires, array = settled_on(plugs)
    whole_ns = timed_scan(array, wires)[1]
    count = 0

    def storm(_: int, messages: tuple[i2c_msg, ...]) -> bool:
        nonlocal count
        count += messages[0].addr == 0x60
        return bool(messages[0].addr == 0x60 and count % 3 == 0)

    wires.on_transaction = failing(121, storm)
    for _ in range(100):
        assert timed_scan(array, wires)[1] < 1.5 * whole_ns


def test_a_tile_that_was_lost_costs_nothing_but_its_first_frame_of_attention() -> None:
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


def test_finding_a_tile_again_costs_one_reading_of_its_coefficients() -> None:
    wires, array = settled_on(FOUR)
    with wires.fault("no_answer", "T03"):
        array.scan_frame()
    _, took_ns = timed_scan(array, wires)
    assert took_ns == WHOLE_NS - (READ - COEFFICIENTS) * BIT_NS


# Single tiles


@every_schedule
def test_a_single_tile_that_comes_and_goes_is_found_again(schedule: ScheduleName) -> None:
    wires, array = settled_on(ONE, schedule)
    with wires.fault("unplugged", "T01"):
        for _ in range(50):
            scan = array.scan_frame()
            assert scan.tile_flags[0] & TileFlag.NO_ANSWER
            assert scan.pressure_raw == [NOT_READ]
    scan = scanned(array, SETTLED + 100)
    assert scan.tile_flags == [0]
