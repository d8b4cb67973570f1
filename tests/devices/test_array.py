"""An array of tiles: who is there, what a frame costs on the wire, and what its flags mean."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from smbus2 import i2c_msg

from devices.array import STALE_AFTER, Scan, TileArray
from devices.clock import VirtualClock
from devices.emulation.i2c_bus import EmulatedI2cAdapter
from devices.emulation.mpl115a2 import EmulatedMpl115a2
from devices.emulation.tca9548a import EmulatedTca9548a
from devices.errors import BusFaultError, BusMisuseError, BusSetupError, TileSetupError
from devices.frames import NOT_READ, TileStatus
from devices.i2c import I2cBus
from devices.scene import Scene, ScheduleName

DATA_SHEET = (0x3ECE, 0xB3F9, 0xC517, 0x33C8)
FORUM = (0x3591, 0xC0A2, 0xC625, 0x2C18)
ZERO = (0, 0, 0, 0)

# SCL periods per transaction, hardware.md 4
SELECT, CONVERT, READ, NOT_ACKNOWLEDGED = 20, 29, 66, 11
TYPICAL_NS = 1_600_000

SceneOf = Callable[..., Scene]
Plugs = tuple[tuple[int, int], ...]
FOUR: Plugs = ((0x70, 0), (0x70, 1), (0x70, 2), (0x70, 3))
TWO_MUXES: Plugs = ((0x70, 0), (0x70, 5), (0x73, 0), (0x73, 1))


def counting(first: int) -> Callable[[int], tuple[int, int]]:
    """A sense in which no two conversions are alike; its tile is told by the hundreds."""
    results: Iterator[int] = iter(range(first, first + 100_000))
    return lambda _: (next(results) % 1000, 500)


class Wires:
    """Emulated tiles under an adapter that notes the transactions and can be made to fail.

    `on_transaction` is called with the number and the messages of each before it takes place.
    """

    def __init__(
        self,
        plugs: Plugs,
        scl_hz: float = 400_000,
        words: dict[int, tuple[int, int, int, int]] | None = None,
    ) -> None:
        self.clock = VirtualClock(7_000_000_000)
        self.tiles = [
            EmulatedMpl115a2((words or {}).get(i, DATA_SHEET), TYPICAL_NS, counting(100 * i + 1))
            for i in range(len(plugs))
        ]
        self.muxes = [
            EmulatedTca9548a(
                address,
                {c: tile for (m, c), tile in zip(plugs, self.tiles, strict=True) if m == address},
            )
            for address in sorted({mux for mux, _ in plugs})
        ]
        self.adapter = EmulatedI2cAdapter(self.muxes, self.clock, scl_hz)
        self.log: list[str] = []
        self.on_transaction: Callable[[int, tuple[i2c_msg, ...]], None] = lambda _, __: None

    def i2c_rdwr(self, *i2c_msgs: i2c_msg) -> None:
        self.log.append(
            " ".join(
                f"{m.addr:02x}>{m.len}" if m.flags & 1 else f"{m.addr:02x}<{bytes(m).hex()}"
                for m in i2c_msgs
            )
        )
        self.on_transaction(len(self.log), i2c_msgs)
        self.adapter.i2c_rdwr(*i2c_msgs)

    def close(self) -> None:
        pass


def array_on(
    wires: Wires,
    scene: Scene,
    schedule: ScheduleName = "simultaneous",
    wait_ms: float = 1.6,
) -> TileArray:
    return TileArray(
        I2cBus(wires, "emulated"), scene.tile, wires.clock, schedule=schedule, wait_ms=wait_ms
    )


def timed_scan(array: TileArray, wires: Wires) -> tuple[Scan, int]:
    """One frame, and how long it took in ns."""
    begin_ns = wires.clock.now_ns()
    return array.scan(), wires.clock.now_ns() - begin_ns


# Identification


def test_every_tile_is_identified_in_the_order_of_the_scene(scene_of: SceneOf) -> None:
    plugs: Plugs = ((0x73, 7), (0x70, 2), (0x73, 0))
    scene = scene_of(plugs)
    wires = Wires(plugs, words={0: FORUM, 1: DATA_SHEET, 2: (0x3000, 0xB000, 0xC000, 0x3000)})
    found = array_on(wires, scene).identify()
    assert [tile.serial for tile in found] == ["T01", "T02", "T03"]
    assert [(tile.mux, tile.channel) for tile in found] == list(plugs)
    assert [tile.coefficient_words for tile in found] == [
        FORUM,
        DATA_SHEET,
        (0x3000, 0xB000, 0xC000, 0x3000),
    ]
    assert [(t.x_m, t.y_m, t.z_m) for t in found] == [(t.x_m, t.y_m, t.z_m) for t in scene.tile]


def test_a_conversion_time_that_was_not_measured_is_the_data_sheets(scene_of: SceneOf) -> None:
    found = array_on(Wires(FOUR), scene_of()).identify()
    # Exactly, because it is printed and kept in files.
    assert [tile.conversion_ms for tile in found] == [1.6] * 4


def test_tiles_are_told_apart_although_every_channel_was_left_open(scene_of: SceneOf) -> None:
    wires = Wires(TWO_MUXES, words={0: FORUM, 3: FORUM})
    for mux in (0x70, 0x73):  # somebody else used the bus before
        wires.adapter.i2c_rdwr(i2c_msg.write(mux, [0xFF]))
    found = array_on(wires, scene_of(TWO_MUXES)).identify()
    assert [t.coefficient_words for t in found] == [FORUM, DATA_SHEET, DATA_SHEET, FORUM]


def test_a_tile_that_is_absent_at_start_up_is_named_with_its_plug(scene_of: SceneOf) -> None:
    wires = Wires(TWO_MUXES)
    wires.tiles[2].silent = lambda _: True
    with pytest.raises(TileSetupError) as caught:
        array_on(wires, scene_of(TWO_MUXES)).identify()
    assert caught.value.where == "tile T03 (mux 0x73 channel 0)"
    assert "does not answer" in caught.value.what
    assert "Plug it in" in caught.value.remedy


def test_a_mux_that_is_absent_at_start_up_is_named_with_the_tile_behind_it(
    scene_of: SceneOf,
) -> None:
    wires = Wires(FOUR)
    with pytest.raises(TileSetupError) as caught:
        array_on(wires, scene_of(((0x74, 6),))).identify()
    assert caught.value.where == "tile T01 (mux 0x74 channel 6)"
    assert "0x74" in caught.value.what


def test_a_part_without_coefficients_is_refused_and_named(scene_of: SceneOf) -> None:
    wires = Wires(FOUR, words={3: ZERO})
    with pytest.raises(TileSetupError, match="no MPL115A2") as caught:
        array_on(wires, scene_of()).identify()
    assert caught.value.where == "tile T04 (mux 0x70 channel 3)"


def test_a_bus_that_fails_at_start_up_is_no_fault_of_a_tile(scene_of: SceneOf) -> None:
    wires = Wires(FOUR)
    wires.on_transaction = failing(110, lambda _, __: True)
    with pytest.raises(BusFaultError):
        array_on(wires, scene_of()).identify()


# What a frame costs on the wire


def simultaneous_ns(plugs: Plugs, period_ns: int) -> int:
    """bus_budget.py, strategy b: the first select is hidden in the wait."""
    n, muxes = len(plugs), len({mux for mux, _ in plugs})
    periods = muxes * SELECT + CONVERT + n * READ + (n - 1) * SELECT + (muxes - 1) * SELECT
    return periods * period_ns + TYPICAL_NS


def sequential_ns(plugs: Plugs, period_ns: int) -> int:
    """bus_budget.py, strategy a."""
    n, muxes = len(plugs), len({mux for mux, _ in plugs})
    closes = muxes if muxes > 1 else 0
    return n * ((SELECT + CONVERT + READ) * period_ns + TYPICAL_NS) + closes * SELECT * period_ns


EIGHT: Plugs = tuple((0x70, channel) for channel in range(8))
SIXTEEN: Plugs = tuple((mux, channel) for mux in (0x70, 0x71) for channel in range(8))
BUDGET: dict[ScheduleName, Callable[[Plugs, int], int]] = {
    "simultaneous": simultaneous_ns,
    "sequential": sequential_ns,
}


@pytest.mark.parametrize(("scl_hz", "period_ns"), [(400_000, 2_500), (250_000, 4_000)])
@pytest.mark.parametrize("plugs", [FOUR[:2], FOUR, EIGHT, TWO_MUXES, SIXTEEN])
@pytest.mark.parametrize("schedule", ["simultaneous", "sequential"])
def test_a_frame_takes_what_the_bus_budget_says_to_the_nanosecond(
    scene_of: SceneOf, schedule: ScheduleName, plugs: Plugs, scl_hz: float, period_ns: int
) -> None:
    wires = Wires(plugs, scl_hz)
    array = array_on(wires, scene_of(plugs), schedule)
    array.identify()
    for _ in range(3):
        scan, took_ns = timed_scan(array, wires)
        assert took_ns == BUDGET[schedule](plugs, period_ns)
        assert scan.status == [0] * len(plugs)


@pytest.mark.parametrize(("schedule", "us"), [("simultaneous", 2532.5), ("sequential", 7550.0)])
def test_four_tiles_at_400_khz_reach_the_published_rates(schedule: ScheduleName, us: float) -> None:
    # 395 and 132 frames/s, hardware.md 4
    assert BUDGET[schedule](FOUR, 2_500) == us * 1_000
    assert round(1e6 / us) == {"simultaneous": 395, "sequential": 132}[schedule]


@pytest.mark.parametrize("schedule", ["simultaneous", "sequential"])
def test_a_single_tile_needs_no_select_after_the_first(
    scene_of: SceneOf, schedule: ScheduleName
) -> None:
    wires = Wires(FOUR[:1])
    array = array_on(wires, scene_of(FOUR[:1]), schedule)
    array.identify()
    wires.log.clear()
    _, took_ns = timed_scan(array, wires)
    assert wires.log == ["60<1200", "60<00 60>4"]
    assert took_ns == (CONVERT + READ) * 2_500 + TYPICAL_NS  # 544 frames/s


def test_a_simultaneous_frame_is_exactly_these_transactions(scene_of: SceneOf) -> None:
    wires = Wires(TWO_MUXES)
    array = array_on(wires, scene_of(TWO_MUXES))
    array.identify()
    wires.log.clear()
    array.scan()
    read = "60<00 60>4"
    assert wires.log == [
        *("70<21", "73<03", "60<1200"),
        *("73<00", "70<01", read),
        *("70<20", read),
        *("70<00", "73<01", read),
        *("73<02", read),
    ]


def test_a_sequential_frame_is_exactly_these_transactions(scene_of: SceneOf) -> None:
    wires = Wires(TWO_MUXES)
    array = array_on(wires, scene_of(TWO_MUXES), "sequential")
    array.identify()
    wires.log.clear()
    array.scan()
    measure = ("60<1200", "60<00 60>4")
    assert wires.log == [
        *("73<00", "70<01", *measure),
        *("70<20", *measure),
        *("70<00", "73<01", *measure),
        *("73<02", *measure),
    ]


# What a frame holds


@pytest.mark.parametrize("schedule", ["simultaneous", "sequential"])
def test_every_frame_is_a_fresh_conversion_of_every_tile(
    scene_of: SceneOf, schedule: ScheduleName
) -> None:
    wires = Wires(TWO_MUXES)
    array = array_on(wires, scene_of(TWO_MUXES), schedule)
    for frame in range(3):
        scan = array.scan()
        assert scan.padc == [100 * i + 1 + frame for i in range(4)]
        assert scan.tadc == [500] * 4
        assert scan.status == [0] * 4
        assert not scan.bus_fault


def test_all_tiles_of_a_simultaneous_frame_convert_at_one_instant(scene_of: SceneOf) -> None:
    wires = Wires(TWO_MUXES)
    begin_ns = wires.clock.now_ns()
    scan = array_on(wires, scene_of(TWO_MUXES)).scan()
    # Nothing is known at first, so both muxes are selected, then comes the CONVERT.
    assert scan.convert_stop_ns == [begin_ns + (2 * SELECT + CONVERT) * 2_500] * 4


def test_each_tile_of_a_sequential_frame_has_an_instant_of_its_own(scene_of: SceneOf) -> None:
    wires = Wires(FOUR)
    begin_ns = wires.clock.now_ns()
    scan = array_on(wires, scene_of(), "sequential").scan()
    first_ns = begin_ns + (SELECT + CONVERT) * 2_500
    step_ns = (SELECT + CONVERT + READ) * 2_500 + TYPICAL_NS
    assert step_ns == 1_887_500
    assert scan.convert_stop_ns == [first_ns + i * step_ns for i in range(4)]


def test_the_sample_is_taken_to_lie_a_quarter_into_a_typical_conversion(scene_of: SceneOf) -> None:
    assert array_on(Wires(FOUR), scene_of()).sample_delay_ns == 400_000


def test_a_wait_that_is_too_short_gives_the_conversion_before(scene_of: SceneOf) -> None:
    wires = Wires(FOUR)
    array = array_on(wires, scene_of(), wait_ms=0.8)
    first, second = array.scan(), array.scan()
    assert first.status == [TileStatus.NOT_CONVERTED] * 4
    assert second.padc == [1, 101, 201, 301]


# Faults


def failing(
    number: int, when: Callable[[int, tuple[i2c_msg, ...]], bool]
) -> Callable[[int, tuple[i2c_msg, ...]], None]:
    def on_transaction(count: int, messages: tuple[i2c_msg, ...]) -> None:
        if when(count, messages):
            raise OSError(number, "injected")

    return on_transaction


def to_tiles(_: int, messages: tuple[i2c_msg, ...]) -> bool:
    return bool(messages[0].addr == 0x60)


@pytest.mark.parametrize("schedule", ["simultaneous", "sequential"])
def test_a_tile_that_falls_silent_leaves_the_others_their_values(
    scene_of: SceneOf, schedule: ScheduleName
) -> None:
    wires = Wires(TWO_MUXES)
    array = array_on(wires, scene_of(TWO_MUXES), schedule)
    array.scan()
    wires.tiles[1].silent = lambda _: True
    for frame in (1, 2, 3):
        scan = array.scan()
        assert scan.padc == [1 + frame, NOT_READ, 201 + frame, 301 + frame]
        assert scan.tadc == [500, NOT_READ, 500, 500]
        assert scan.status == [0, TileStatus.NO_ANSWER, 0, 0]
        assert not scan.bus_fault
    wires.tiles[1].silent = lambda _: False
    scan = array.scan()
    assert scan.status == [0] * 4
    assert scan.padc[1] != NOT_READ


def test_a_silent_tile_is_asked_twice_in_its_first_frame_and_once_from_then_on(
    scene_of: SceneOf,
) -> None:
    wires = Wires(FOUR)
    array = array_on(wires, scene_of())
    array.scan()
    wires.tiles[1].silent = lambda _: True
    whole_ns = simultaneous_ns(FOUR, 2_500)
    without_ns = whole_ns - (READ - NOT_ACKNOWLEDGED) * 2_500
    _, first_ns = timed_scan(array, wires)
    assert first_ns == without_ns + (SELECT + NOT_ACKNOWLEDGED) * 2_500
    for _ in range(3):
        _, took_ns = timed_scan(array, wires)
        assert took_ns == without_ns
    assert first_ns < whole_ns, "not even the first frame is late"


@pytest.mark.parametrize("schedule", ["simultaneous", "sequential"])
def test_one_missing_acknowledge_is_mended_within_the_frame_and_flagged(
    scene_of: SceneOf, schedule: ScheduleName
) -> None:
    wires = Wires(FOUR)
    array = array_on(wires, scene_of(), schedule)
    array.scan()
    reads = 0

    def third_read(_: int, messages: tuple[i2c_msg, ...]) -> bool:
        nonlocal reads
        reads += len(messages) == 2
        return reads == 3 and len(messages) == 2

    wires.on_transaction = failing(121, third_read)
    scan = array.scan()
    assert scan.status == [0, 0, TileStatus.RETRIED, 0]
    assert NOT_READ not in scan.padc
    assert not scan.bus_fault
    wires.on_transaction = lambda _, __: None
    assert array.scan().status == [0] * 4


def test_a_broadcast_that_nobody_acknowledged_is_tried_once_more(scene_of: SceneOf) -> None:
    wires = Wires(FOUR)
    array = array_on(wires, scene_of())
    array.scan()
    wires.log.clear()
    wires.on_transaction = failing(121, lambda count, _: count == 2)
    scan = array.scan()
    assert wires.log[:4] == ["70<0f", "60<1200", "70<0f", "60<1200"]
    assert scan.status == [TileStatus.RETRIED] * 4
    assert scan.padc == [2, 102, 202, 302]


def test_a_mux_that_lost_its_routing_between_two_tiles_is_set_up_again(scene_of: SceneOf) -> None:
    wires = Wires(FOUR)
    array = array_on(wires, scene_of())
    array.scan()
    wires.log.clear()

    def brown_out(count: int, messages: tuple[i2c_msg, ...]) -> None:
        if wires.log == ["70<0f", "60<1200", "70<01", "60<00 60>4", "70<02", "60<00 60>4"]:
            wires.adapter.i2c_rdwr(i2c_msg.write(0x70, [0]))

    wires.on_transaction = brown_out
    scan = array.scan()
    assert scan.status == [0, TileStatus.RETRIED, 0, 0]
    assert scan.padc == [2, 102, 202, 302]


def test_a_foot_without_any_tile_left_is_still_a_frame(scene_of: SceneOf) -> None:
    wires = Wires(FOUR)
    array = array_on(wires, scene_of())
    for tile in wires.tiles:
        tile.silent = lambda _: True
    for _ in range(2):
        begin_ns = wires.clock.now_ns()
        scan, took_ns = timed_scan(array, wires)
        assert scan.padc == scan.tadc == [NOT_READ] * 4
        assert scan.status == [TileStatus.NO_ANSWER] * 4
        assert not scan.bus_fault
        assert took_ns > 0
        assert begin_ns <= scan.convert_stop_ns[0] <= wires.clock.now_ns()


@pytest.mark.parametrize("number", [5, 110, 11, 16])
@pytest.mark.parametrize("schedule", ["simultaneous", "sequential"])
def test_a_fault_of_the_bus_is_told_from_a_silent_tile(
    scene_of: SceneOf, schedule: ScheduleName, number: int
) -> None:
    wires = Wires(FOUR)
    array = array_on(wires, scene_of(), schedule)
    array.scan()
    wires.on_transaction = failing(number, lambda _, __: True)
    scan = array.scan()
    assert scan.bus_fault
    assert scan.padc == [NOT_READ] * 4
    assert scan.status == [TileStatus.NO_ANSWER] * 4
    wires.on_transaction = lambda _, __: None
    scan = array.scan()
    assert not scan.bus_fault
    assert scan.status == [0] * 4


def test_a_fault_of_the_bus_shows_although_the_second_attempt_succeeded(scene_of: SceneOf) -> None:
    wires = Wires(FOUR)
    array = array_on(wires, scene_of())
    wires.on_transaction = failing(11, lambda count, _: count == 4)  # the first tile's read
    scan = array.scan()
    assert scan.bus_fault
    assert scan.status == [TileStatus.RETRIED, 0, 0, 0]
    assert scan.padc == [1, 101, 201, 301]


@pytest.mark.parametrize(
    ("number", "kind"), [(22, BusMisuseError), (95, BusMisuseError), (19, BusSetupError)]
)
@pytest.mark.parametrize("schedule", ["simultaneous", "sequential"])
def test_a_bug_of_ours_and_a_bus_that_is_gone_are_raised_and_not_flagged(
    scene_of: SceneOf, schedule: ScheduleName, number: int, kind: type[Exception]
) -> None:
    wires = Wires(FOUR)
    array = array_on(wires, scene_of(), schedule)
    wires.on_transaction = failing(number, to_tiles)
    with pytest.raises(kind):
        array.scan()


def test_a_part_that_was_just_powered_up_is_flagged_as_not_converted(scene_of: SceneOf) -> None:
    wires = Wires(FOUR)
    wires.tiles[3].frozen = lambda _: True
    scan = array_on(wires, scene_of()).scan()
    assert scan.status == [0, 0, 0, TileStatus.NOT_CONVERTED]
    assert (scan.padc[3], scan.tadc[3]) == (0, 0)


@pytest.mark.parametrize(
    ("words", "status"),
    [
        ((1023, 1023), TileStatus.IMPLAUSIBLE),
        ((0, 0), TileStatus.NOT_CONVERTED),
        ((1023, 500), 0),
        ((500, 1023), 0),
        ((0, 500), 0),
        ((500, 0), 0),
    ],
)
def test_only_both_words_together_are_implausible(
    scene_of: SceneOf, words: tuple[int, int], status: int
) -> None:
    wires = Wires(FOUR[:1])

    def answer(_: int, messages: tuple[i2c_msg, ...]) -> None:
        wires.tiles[0]._registers[0:4] = struct.pack(">2H", words[0] << 6, words[1] << 6)

    array = array_on(wires, scene_of(FOUR[:1]))
    wires.tiles[0].frozen = lambda _: True
    wires.on_transaction = answer
    scan = array.scan()
    assert scan.status == [status]
    assert (scan.padc, scan.tadc) == ([words[0]], [words[1]])


def test_a_part_that_stopped_converting_is_stale_after_so_many_repeats(scene_of: SceneOf) -> None:
    wires = Wires(FOUR)
    array = array_on(wires, scene_of())
    array.scan()
    array.scan()
    wires.tiles[2].frozen = lambda _: True
    # The reading that is repeated is the one of the second frame.
    statuses = [array.scan().status for _ in range(STALE_AFTER + 5)]
    good, stale = [0] * 4, [0, 0, TileStatus.STALE, 0]
    assert statuses == [good] * (STALE_AFTER - 1) + [stale] * 6
    wires.tiles[2].frozen = lambda _: False
    assert array.scan().status == good


def test_a_silent_tile_is_never_called_stale(scene_of: SceneOf) -> None:
    wires = Wires(FOUR)
    array = array_on(wires, scene_of())
    wires.tiles[0].silent = lambda _: True
    for _ in range(2 * STALE_AFTER):
        assert array.scan().status == [TileStatus.NO_ANSWER, 0, 0, 0]


@pytest.mark.parametrize("word", ["padc", "tadc"])
def test_a_part_of_which_either_word_changes_is_not_stale(scene_of: SceneOf, word: str) -> None:
    wires = Wires(FOUR[:1])
    results = iter(range(10_000))

    def sense(_: int) -> tuple[int, int]:
        changing = 300 + next(results) % 2
        return (changing, 500) if word == "padc" else (300, changing)

    wires.tiles[0]._sense = sense
    array = array_on(wires, scene_of(FOUR[:1]))
    assert [array.scan().status for _ in range(2 * STALE_AFTER)] == [[0]] * (2 * STALE_AFTER)


def test_an_array_of_one_schedule_knows_its_name(scene_of: SceneOf) -> None:
    for name in ("simultaneous", "sequential"):
        schedule: Any = name
        assert array_on(Wires(FOUR), scene_of(), schedule).schedule_name == name
