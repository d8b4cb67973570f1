"""An array of tiles: what a frame holds, and what its flags mean when a transfer fails."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import pairwise

import pytest
from smbus2 import i2c_msg

from devices.array.array import TileArray
from devices.errors import BusMisuseError, BusSetupError, SceneError
from devices.frames import NOT_READ, TileStatus
from devices.scene.hardware import ScheduleName
from tests.devices.rigs import (
    COEFFICIENTS,
    CONVERT,
    FORUM,
    FOUR,
    LOOK_FRAMES,
    NOT_ACKNOWLEDGED,
    ONE,
    READ,
    SCHEDULES,
    SELECT,
    SETTLED,
    TWO_MUXES,
    TYPICAL_NS,
    Plugs,
    Wires,
    array_on,
    full,
    settled,
    timed_scan,
)

BIT_NS = 2_500
WHOLE_NS = (4 * SELECT + CONVERT + 4 * READ) * BIT_NS + TYPICAL_NS  # simultaneous, four tiles
READS_THE_FRAME_BEFORE = ("pipelined", "per_mux")
"""Schedules that read what the frame before has started."""

every_schedule = pytest.mark.parametrize("schedule", SCHEDULES)


# What a frame holds


@every_schedule
def test_every_frame_is_a_fresh_conversion_of_every_tile(schedule: ScheduleName) -> None:
    array = array_on(wires := Wires(TWO_MUXES), schedule)
    first = array.scan()
    last = [100 * i + 1 for i in range(4)]
    if schedule in READS_THE_FRAME_BEFORE:
        converted = [status != TileStatus.NOT_CONVERTED for status in first.status]
        # per_mux has had the tiles of the last mux convert before it came to them.
        assert converted == [False, False] + [schedule == "per_mux"] * 2
        array.scan()
        last = array.scan().padc
    else:
        assert first.padc == last
        assert first.status == [0] * 4
    for _ in range(10):
        scan = array.scan()
        last = [padc + 1 for padc in last]
        assert scan.padc == last
        assert scan.tadc == [500] * 4
        assert scan.status == [0] * 4
        assert not scan.bus_fault
    assert [padc // 100 for padc in last] == [0, 1, 2, 3], "each tile's own"
    assert wires.clock.now_ns() > 0


def test_all_tiles_of_a_simultaneous_frame_convert_at_one_instant() -> None:
    wires = Wires(TWO_MUXES)
    array = array_on(wires)
    begin_ns = wires.clock.now_ns()
    # Nothing is known at first, so both muxes are selected, then comes the CONVERT.
    assert array.scan().convert_stop_ns == [begin_ns + (2 * SELECT + CONVERT) * BIT_NS] * 4


def test_each_tile_of_a_sequential_frame_has_an_instant_of_its_own() -> None:
    wires = Wires(FOUR)
    array = settled(wires, "sequential")
    first_ns = wires.clock.now_ns() + (SELECT + CONVERT) * BIT_NS
    step_ns = (SELECT + CONVERT + READ) * BIT_NS + TYPICAL_NS
    assert step_ns == 1_887_500
    assert array.scan().convert_stop_ns == [first_ns + i * step_ns for i in range(4)]


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
    array.scan()
    for _ in range(20):
        scan = array.scan()
        for i in range(4):
            assert scan.convert_stop_ns[i] == told[i][scan.padc[i], scan.tadc[i]]


def test_the_sample_is_taken_to_lie_a_quarter_into_each_parts_own_conversion() -> None:
    array = array_on(Wires(FOUR, tc_ns=[1_600_000, 1_400_000, 2_000_000, 2_999_999]))
    assert array.sample_delay_ns == (400_000, 350_000, 500_000, 749_999)


def test_a_wait_that_is_too_short_gives_the_conversion_before() -> None:
    array = array_on(Wires(FOUR), waits_ns=[800_000] * 4)
    first, second = array.scan(), array.scan()
    assert first.status[0] == TileStatus.NOT_CONVERTED
    assert second.padc[0] != 2


def test_an_array_knows_its_tiles_and_which_are_behind_one_mux() -> None:
    for name in SCHEDULES:
        wires = Wires(TWO_MUXES)
        array = array_on(wires, name)
        assert array.tiles == wires.infos
        assert array.by_mux == ((0, 1), (2, 3))


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
        scan = array.scan()
        assert scan.reference_n == 0.25 * frame
        assert len(asked_ns) == frame
        assert asked_ns[-1] == scan.convert_stop_ns[0] + 400_000 == scan.reference_ns


def test_what_stands_beside_costs_no_time_on_the_bus() -> None:
    array = settled(wires := Wires(FOUR), reference_n=lambda: 1.0)
    assert timed_scan(array, wires)[1] == WHOLE_NS


def test_without_anything_beside_there_is_no_force() -> None:
    scan = array_on(Wires(FOUR)).scan()
    assert scan.reference_n != scan.reference_n  # NaN


# Temperature in every k-th frame


@every_schedule
@pytest.mark.parametrize("every", [2, 3, 10])
def test_temperature_is_read_in_every_kth_frame_and_not_known_in_between(
    schedule: ScheduleName, every: int
) -> None:
    array = array_on(Wires(FOUR), schedule, temperature_every=every)
    array.scan()
    array.scan()  # by now every tile has one, whatever the count of frames says
    for frame in range(2, 32):
        scan = array.scan()
        assert scan.tadc == [500 if frame % every == 0 else NOT_READ] * 4
        assert NOT_READ not in scan.padc
        assert scan.status == [0] * 4


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
    scans = [array.scan() for _ in range(3)]
    for i in range(4):
        first = next(scan for scan in scans if not scan.status[i])
        assert first.tadc[i] == 500


def test_a_tile_that_comes_back_brings_its_temperature() -> None:
    wires = Wires(FOUR)
    array = settled(wires, temperature_every=1000)
    with wires.fault("no_answer", "T02"):
        array.scan()
    while (scan := array.scan()).status[1]:
        pass
    assert scan.tadc == [NOT_READ, 500, NOT_READ, NOT_READ]


# Faults of a tile


def failing(
    number: int, when: Callable[[int, tuple[i2c_msg, ...]], bool]
) -> Callable[[int, tuple[i2c_msg, ...]], None]:
    def on_transaction(count: int, messages: tuple[i2c_msg, ...]) -> None:
        if when(count, messages):
            raise OSError(number, "injected")

    return on_transaction


def to_tiles(_: int, messages: tuple[i2c_msg, ...]) -> bool:
    return bool(messages[0].addr == 0x60)


@every_schedule
def test_a_tile_that_falls_silent_leaves_the_others_their_values(schedule: ScheduleName) -> None:
    wires = Wires(TWO_MUXES)
    array = settled(wires, schedule)
    last = array.scan().padc
    with wires.fault("no_answer", "T02"):
        for _ in range(20):
            scan = array.scan()
            last = [padc + 1 for padc in last]
            assert [padc for i, padc in enumerate(scan.padc) if i != 1] == [
                padc for i, padc in enumerate(last) if i != 1
            ]
            assert (scan.padc[1], scan.tadc[1]) == (NOT_READ, NOT_READ)
            assert scan.status[1] & TileStatus.NO_ANSWER
            assert [status for i, status in enumerate(scan.status) if i != 1] == [0] * 3
            assert not scan.bus_fault


@pytest.mark.parametrize("schedule", ["simultaneous", "pipelined", "per_mux"])
def test_a_silent_tile_is_told_by_one_flag(schedule: ScheduleName) -> None:
    wires = Wires(TWO_MUXES)
    array = settled(wires, schedule)
    with wires.fault("no_answer", "T02"):
        for _ in range(20):
            assert array.scan().status == [0, TileStatus.NO_ANSWER, 0, 0]


def test_a_silent_tile_is_asked_twice_in_its_first_frame_and_ever_more_rarely_from_then_on() -> (
    None
):
    wires = Wires(FOUR)
    array = settled(wires)
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
    wires = Wires(TWO_MUXES)
    array = settled(wires, schedule)
    with wires.fault("unplugged", "T02"):
        for _ in range(3):
            array.scan()
    wires.log.clear()
    frames = 0
    while array.scan().status[1]:
        frames += 1
        assert frames < 100
    # Its coefficients, one channel at a time (hardware.md 2), before its first reading.
    assert wires.log.index("60<04 60>8") > wires.log.index("70<20")
    assert sum(entry == "60<04 60>8" for entry in wires.log) == 1


@every_schedule
def test_a_tile_that_was_powered_up_anew_is_not_read_before_it_has_converted(
    schedule: ScheduleName,
) -> None:
    wires = Wires(TWO_MUXES)
    array = settled(wires, schedule)
    with wires.fault("unplugged", "T02"):
        array.scan()
        array.scan()
    for _ in range(100):
        scan = array.scan()
        assert scan.status[1] or scan.padc[1] > 100, "zeros are no reading"
    assert scan.status == [0] * 4


@every_schedule
def test_another_part_in_the_place_of_a_tile_is_never_believed(schedule: ScheduleName) -> None:
    wires = Wires(TWO_MUXES)
    array = settled(wires, schedule)
    with wires.fault("no_answer", "T02"):
        array.scan()
    plug_another(wires, 1)
    for _ in range(300):
        scan = array.scan()
        assert scan.status[1] & TileStatus.UNUSABLE
        assert [status for i, status in enumerate(scan.status) if i != 1] == [0] * 3
    assert scan.status[1] == TileStatus.IMPLAUSIBLE
    assert array.replaced == ("T02",)
    assert "another part" in array.troubles()["T02"]
    wires.log.clear()
    array.scan()
    assert "70<20" not in wires.log or "60<04 60>8" not in wires.log, "it is left alone"


def plug_another(wires: Wires, tile: int) -> None:
    """Another part, of other coefficients, that reads the very same counts."""
    silicon = wires.tiles[tile]._silicon
    wires.tiles[tile]._silicon = type(silicon)(FORUM, silicon.conversion_ns, silicon.sense)
    wires.tiles[tile]._power_up()


@every_schedule
def test_another_part_is_not_believed_even_if_only_one_convert_was_missed(
    schedule: ScheduleName,
) -> None:
    wires = Wires(TWO_MUXES)
    array = settled(wires, schedule)
    silent = False

    def swap(_: int, messages: tuple[i2c_msg, ...]) -> None:
        # Silent from its CONVERT on (or, in a broadcast, from the first time it is alone).
        nonlocal silent
        alone = wires.muxes[0].mask == 0b100000 and wires.muxes[1].mask == 0
        if messages[0].addr == 0x60 and alone:
            if bytes(messages[0]) == b"\x12\0" or schedule in ("simultaneous", "per_mux"):
                silent = True
            if silent:
                raise OSError(121, "nobody there")

    wires.on_transaction = swap
    for _ in range(3):
        array.scan()
    assert silent
    wires.on_transaction = lambda _, __: None
    plug_another(wires, 1)
    for _ in range(300):
        assert array.scan().status[1] & TileStatus.UNUSABLE
    assert array.replaced == ("T02",)


@every_schedule
def test_one_missing_acknowledge_is_mended_within_the_frame_and_flagged(
    schedule: ScheduleName,
) -> None:
    wires = Wires(FOUR)
    array = settled(wires, schedule)
    for _ in range(5):  # whatever the turn of the tile is
        mended(wires, array, 2)


@every_schedule
def test_so_it_is_if_the_tile_was_waited_for(schedule: ScheduleName) -> None:
    wires = Wires(FOUR)
    array = settled(wires, schedule)
    for _ in range(5):
        mended(wires, array, 0)


@every_schedule
def test_so_it_is_in_an_array_of_one(schedule: ScheduleName) -> None:
    wires = Wires(ONE)
    array = settled(wires, schedule)
    before = [array.scan().padc[0] for _ in range(3)]
    wires.log.clear()
    failed: list[bool] = []

    def first_read(_: int, messages: tuple[i2c_msg, ...]) -> bool:
        if len(messages) < 2 or failed:
            return False
        failed.append(True)
        return True

    wires.on_transaction = failing(121, first_read)
    scan = array.scan()
    assert scan.status == [TileStatus.RETRIED]
    assert scan.budget_ns > 0, "a read that failed at once has cost a few bits"
    assert scan.padc[0] == before[-1] + 1


def mended(wires: Wires, array: TileArray, tile: int) -> None:
    """The first read of one tile is not acknowledged: what the frame says of it."""
    if array._frames % LOOK_FRAMES == 0:
        array.scan()  # in which somebody is read once more
    reads = 0

    def one_read(_: int, messages: tuple[i2c_msg, ...]) -> bool:
        nonlocal reads
        reads += len(messages) == 2
        return reads == tile + 1 and len(messages) == 2

    wires.on_transaction = failing(121, one_read)
    scan = array.scan()
    wires.on_transaction = lambda _, __: None
    assert scan.status == [TileStatus.RETRIED if i == tile else 0 for i in range(4)]
    assert NOT_READ not in scan.padc
    assert not scan.bus_fault
    assert array.scan().status == [0] * 4


def test_a_broadcast_that_nobody_acknowledged_is_tried_once_more() -> None:
    wires = Wires(FOUR)
    array = settled(wires)
    last = array.scan().padc
    wires.log.clear()
    wires.on_transaction = failing(121, lambda count, _: count == 2)
    scan = array.scan()
    assert wires.log[:4] == ["70<0f", "60<1200", "70<0f", "60<1200"]
    assert scan.status == [TileStatus.RETRIED] * 4
    assert scan.padc == [padc + 1 for padc in last]


@every_schedule
def test_a_mux_that_was_reset_behind_our_back_costs_no_sample_of_a_tile_read_later(
    schedule: ScheduleName,
) -> None:
    wires = Wires(FOUR)
    array = settled(wires, schedule)
    reads = 0

    def reset(_: int, messages: tuple[i2c_msg, ...]) -> None:
        nonlocal reads
        reads += len(messages) == 2
        if len(messages) == 2 and reads == 3:
            wires.muxes[0].reset()

    wires.on_transaction = reset
    # The adapter looks at its muxes at every transfer only if something may be wrong with them.
    with wires.fault("mux_reset", "0x77"):
        scan = array.scan()
    assert scan.status == [0, 0, TileStatus.RETRIED, 0]
    assert array.scan().status == [0] * 4


@every_schedule
def test_a_foot_without_any_tile_left_is_still_a_frame(schedule: ScheduleName) -> None:
    wires = Wires(FOUR)
    array = settled(wires, schedule)
    wires.on_transaction = failing(121, to_tiles)
    for _ in range(20):
        begin_ns = wires.clock.now_ns()
        scan, took_ns = timed_scan(array, wires)
        assert scan.padc == scan.tadc == [NOT_READ] * 4
        assert all(status & TileStatus.NO_ANSWER for status in scan.status)
        assert not scan.bus_fault, "the muxes keep what is written to them"
        assert took_ns >= 1_000_000, "nothing to do is no reason to hurry"
        assert begin_ns - took_ns <= scan.convert_stop_ns[0] <= wires.clock.now_ns()
    wires.on_transaction = lambda _, __: None
    for _ in range(200):
        scan = array.scan()
    assert scan.status == [0] * 4


def test_one_disturbed_select_does_not_make_a_tile_another_part() -> None:
    wires = Wires(FOUR, words={3: FORUM})
    array = settled(wires)
    with wires.fault("no_answer", "T02"):
        array.scan()
    disturbed: list[bool] = []

    def disturb() -> None:
        if wires.log[-1] == "70<02" and not disturbed:
            disturbed.append(True)
            wires.adapter.i2c_rdwr(i2c_msg.write(0x70, [0b1000]))  # a bit or two turned over

    wires.after_transaction = disturb
    for _ in range(100):
        scan = array.scan()
    assert disturbed
    assert array.replaced == ()
    assert scan.status == [0] * 4


@every_schedule
def test_one_disturbed_select_passes_on_no_word_of_another_tile(schedule: ScheduleName) -> None:
    wires = Wires(FOUR, words={3: FORUM})
    array = settled(wires, schedule)
    last = array.scan().padc
    disturbed: list[bool] = []

    def disturb() -> None:
        if wires.log[-1] == "70<02" and not disturbed:
            disturbed.append(True)
            wires.adapter.i2c_rdwr(i2c_msg.write(0x70, [0b1000]))

    wires.after_transaction = disturb
    for _ in range(20):
        scan = array.scan()
        last = [padc + 1 for padc in last]
        for i in range(4):
            assert scan.status[i] & TileStatus.UNUSABLE or abs(scan.padc[i] - last[i]) <= 1
    assert disturbed
    assert scan.status == [0] * 4


# Faults of the bus


@pytest.mark.parametrize("number", [5, 110, 11, 16])
@every_schedule
def test_a_fault_of_the_bus_is_told_from_a_silent_tile(schedule: ScheduleName, number: int) -> None:
    wires = Wires(FOUR)
    array = settled(wires, schedule)
    wires.on_transaction = failing(number, lambda _, __: True)
    for _ in range(3):
        scan = array.scan()
        assert scan.bus_fault
        assert scan.padc == [NOT_READ] * 4
        assert all(status & TileStatus.NO_ANSWER for status in scan.status)
    assert "stuck" in array.troubles()[""]
    wires.on_transaction = lambda _, __: None
    for _ in range(3):
        scan = array.scan()
    assert not scan.bus_fault
    assert scan.status == [0] * 4
    assert array.troubles() == {}


def test_a_stuck_bus_is_asked_for_once_a_frame_and_no_more() -> None:
    # Each transfer may cost the adapter's 30 ms.
    wires = Wires(FOUR)
    array = settled(wires)
    wires.on_transaction = failing(110, lambda _, __: True)
    wires.log.clear()
    array.scan()
    assert len(wires.log) == 2, "after two time-outs stop (hardware.md 8)"
    for _ in range(5):
        wires.log.clear()
        array.scan()
        assert len(wires.log) == 1


def test_a_fault_of_the_bus_shows_although_the_second_attempt_succeeded() -> None:
    wires = Wires(FOUR)
    array = settled(wires)
    last = array.scan().padc
    wires.log.clear()
    wires.on_transaction = failing(11, lambda count, _: count == 4)  # the first tile's read
    scan = array.scan()
    assert scan.bus_fault
    assert scan.status == [TileStatus.RETRIED, 0, 0, 0]
    assert scan.padc == [padc + 1 for padc in last]


@pytest.mark.parametrize(
    ("number", "kind"), [(22, BusMisuseError), (95, BusMisuseError), (19, BusSetupError)]
)
@every_schedule
def test_a_bug_of_ours_and_a_bus_that_is_gone_are_raised_and_not_flagged(
    schedule: ScheduleName, number: int, kind: type[Exception]
) -> None:
    wires = Wires(FOUR)
    array = array_on(wires, schedule)
    array.scan()
    wires.on_transaction = failing(number, to_tiles)
    with pytest.raises(kind):
        array.scan()


@every_schedule
def test_a_bus_that_is_gone_is_raised_wherever_it_is_noticed(schedule: ScheduleName) -> None:
    for after in range(60):
        wires = Wires(FOUR)
        array = settled(wires, schedule)
        with wires.fault("no_answer", "T02"):  # one tile is looked for, too
            array.scan()
        wires.log.clear()
        wires.on_transaction = failing(19, partial(later_than, after))
        with pytest.raises(BusSetupError):
            frames(array, 20)


@every_schedule
@pytest.mark.parametrize("plugs", [ONE, FOUR, TWO_MUXES])
def test_a_bus_on_which_nobody_answers_is_a_fault_of_the_bus_from_the_first_frame_on(
    schedule: ScheduleName, plugs: Plugs
) -> None:
    wires = Wires(plugs)
    array = settled(wires, schedule)
    with wires.fault("sda_high"):
        for _ in range(10):
            scan = array.scan()
            assert scan.bus_fault
            assert all(status & TileStatus.NO_ANSWER for status in scan.status)
    for _ in range(SETTLED + 2):
        scan = array.scan()
    assert scan.status == [0] * len(plugs)


@every_schedule
@pytest.mark.parametrize("plugs", [ONE, FOUR, TWO_MUXES])
def test_a_bus_that_acknowledges_everything_and_reads_as_zeros_is_stuck(
    schedule: ScheduleName, plugs: Plugs
) -> None:
    # hardware.md 8: 0/0 on several tiles, 50.00 kPa with all-zero coefficients
    wires = Wires(plugs)
    array = settled(wires, schedule)
    with wires.fault("sda_low"):
        for _ in range(10):
            scan = array.scan()
            assert scan.bus_fault
            assert all(status & TileStatus.UNUSABLE for status in scan.status)
    for _ in range(SETTLED + 2):
        scan = array.scan()
    assert scan.status == [0] * len(plugs)
    assert not scan.bus_fault


@every_schedule
@pytest.mark.parametrize("broken", [0x70, 0x73])
def test_the_tiles_of_the_other_mux_go_on_while_one_is_without_supply(
    schedule: ScheduleName, broken: int
) -> None:
    wires = Wires(TWO_MUXES)
    array = settled(wires, schedule)
    others = array.by_mux[1 if broken == 0x70 else 0]
    with wires.fault("brown_out", f"0x{broken:02x}"):
        scans = [array.scan() for _ in range(100)]
    for scan in scans:
        for i in range(4):
            if i not in others:
                assert scan.status[i] & TileStatus.NO_ANSWER
                assert scan.padc[i] == NOT_READ
    for before, after in pairwise(scans[5:]):
        for i in others:
            assert after.status[i] == 0
            assert after.padc[i] == before.padc[i] + 1
    for _ in range(200):
        scan = array.scan()
    assert scan.status == [0] * 4


def later_than(after: int, count: int, _: tuple[i2c_msg, ...]) -> bool:
    return count > after


def frames(array: TileArray, count: int) -> None:
    for _ in range(count):
        array.scan()


# The budget of second attempts


def test_one_bad_plug_does_not_slow_the_others_down() -> None:
    # Every transfer of one tile fails at every second attempt: it is never quite lost.
    wires = Wires(FOUR)
    array = settled(wires)
    bad = 0

    def first(_: int, messages: tuple[i2c_msg, ...]) -> bool:
        nonlocal bad
        if messages[0].addr != 0x60 or wires.muxes[0].mask != 0b0010:
            return False
        bad += 1
        return bad == 1

    wires.on_transaction = failing(121, first)
    begin_ns = wires.clock.now_ns()
    scans = []
    for _ in range(100):
        bad = 0
        scans.append(array.scan())
    assert (wires.clock.now_ns() - begin_ns) / 100 <= 1.05 * WHOLE_NS
    # In one frame of ten the first is a second look at the reading before, which is not repeated.
    retried = [scan.status[1] == TileStatus.RETRIED for scan in scans]
    assert sum(retried) >= 90
    assert all(scan.status[1] in (0, TileStatus.RETRIED) for scan in scans)
    assert all(scan.status[i] == 0 for scan in scans for i in (0, 2, 3))


def test_second_attempts_share_a_budget_so_that_a_storm_does_not_halve_the_rate() -> None:
    plugs = full(8)
    wires = Wires(plugs)
    array = settled(wires)
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
    wires = Wires(FOUR)
    array = settled(wires)
    with wires.fault("no_answer", "T03"):
        for _ in range(3):
            array.scan()
        wires.log.clear()
        array.scan()
    assert wires.log == [
        *("70<0f", "60<1200"),
        *("70<01", "60<00 60>4", "70<02", "60<00 60>4"),
        *("70<08", "60<00 60>4"),
    ]


def test_finding_a_tile_again_costs_one_reading_of_its_coefficients() -> None:
    wires = Wires(FOUR)
    array = settled(wires)
    with wires.fault("no_answer", "T03"):
        array.scan()
    _, took_ns = timed_scan(array, wires)
    assert took_ns == WHOLE_NS - (READ - COEFFICIENTS) * BIT_NS


# Single tiles


@every_schedule
def test_a_single_tile_that_comes_and_goes_is_found_again(schedule: ScheduleName) -> None:
    wires = Wires(ONE)
    array = settled(wires, schedule)
    with wires.fault("unplugged", "T01"):
        for _ in range(50):
            scan = array.scan()
            assert scan.status[0] & TileStatus.NO_ANSWER
            assert scan.padc == [NOT_READ]
    for _ in range(SETTLED + 100):
        scan = array.scan()
    assert scan.status == [0]


# What is wrong, in words


class NoLines:
    """A recovery whose lines are somebody else's."""

    def clock_out(self) -> bool:
        raise BusSetupError("GPIO lines cannot be used (EBUSY)", where="/dev/gpiochip0, lines 2, 3")

    def reset_muxes(self) -> bool:
        return False


def test_a_stuck_bus_is_said_and_what_kept_it_from_being_helped() -> None:
    wires = Wires(FOUR)
    plain, helped = array_on(wires), array_on(wires, recovery=NoLines())
    for array in (plain, helped):
        with wires.fault("sda_low"):
            frames(array, 3)
            assert list(array.troubles()) == [""]
            text = array.troubles()[""]
        frames(array, 200)
        assert array.troubles() == {}
        assert text.startswith("the bus is stuck or cut")
        assert ("GPIO lines cannot be used" in text) == (array is helped)


# A stream begins, and goes on


@every_schedule
def test_after_something_else_used_the_bus_nothing_is_read_that_was_started_before(
    schedule: ScheduleName,
) -> None:
    wires = Wires(TWO_MUXES)
    array = settled(wires, schedule)
    wires.bus.transfer(i2c_msg.write(0x73, [0xFF]))
    wires.clock.sleep_until_ns(wires.clock.now_ns() + 1_000_000_000)
    resumed_ns = wires.clock.now_ns()
    array.resume()
    scan = array.scan()
    for i in range(4):
        read = scan.padc[i] != NOT_READ
        assert scan.status[i] == (0 if read else TileStatus.NOT_CONVERTED)
        assert scan.convert_stop_ns[i] > resumed_ns or not read
    assert array.scan().status == [0] * 4


def test_what_went_wrong_is_counted_from_the_begin_of_a_stream_and_on_when_it_goes_on() -> None:
    wires = Wires(FOUR)
    array = settled(wires)
    with wires.fault("no_answer", "T03"):
        array.scan()
    counted = dict(array.health[2].counts)
    assert counted["no_answer"] == 1
    array.resume()
    assert dict(array.health[2].counts) == counted
    array.begin()
    assert not array.health[2].counts
