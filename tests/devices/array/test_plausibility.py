"""Plausibility of readings and of conversion times: a doubtful reading is read again."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from devices.array.plausibility import ConversionMonitor
from devices.array.schedules import BusTiming
from devices.array.tile import TileHealth, TileIo
from devices.array.tile_array import TileArray
from devices.errors import NoAcknowledgeError
from devices.flags import TileFlag
from tests.builders.arrays import FORUM_CHIP
from tests.devices.rigs import FOUR, LOOK_FRAMES, TYPICAL_NS, Wires, hesitating, settled_on

Foot = tuple[Wires, TileArray]


def tamper(wires: Wires, tile: int, change: Callable[[int, list[int]], None]) -> None:
    """Let `change` modify the data bytes of a tile's readings, given their number from 0."""
    part = wires.tiles[tile]
    send_bytes, numbers = part.send_bytes, iter(range(10_000))

    def send_changed_bytes(n_bytes: int) -> bytes:
        raw = list(send_bytes(n_bytes))
        if n_bytes in (2, 4):
            change(next(numbers), raw)
        return bytes(raw)

    part.send_bytes = send_changed_bytes  # type: ignore[method-assign,assignment]  # of this part only


def flip(wires: Wires, tile: int, *masks: int, later: int = 0) -> None:
    """Flip these bits of a tile's pressure counts, a mask for each reading and one for later."""

    def change(number: int, raw: list[int]) -> None:
        mask = masks[number] if number < len(masks) else later
        raw[:2] = (int.from_bytes(raw[:2], "big") ^ mask << 6).to_bytes(2, "big")

    tamper(wires, tile, change)


def go_to_quiet_frame(array: TileArray) -> None:
    """Scan up to a frame that is followed by some in which no tile is read again."""
    while array._frame_index % LOOK_FRAMES not in (2, 3):
        array.scan_frame()


def count_reads(wires: Wires, tile: int) -> int:
    """Count the reads of a tile in the log."""
    connected, reads = "", 0
    for entry in wires.log:
        if entry.startswith("70<"):
            connected = entry
        reads += entry.startswith("60<00") and connected == f"70<{1 << tile:02x}"
    return reads


@pytest.fixture
def foot() -> Foot:
    wires, array = settled_on(FOUR)
    go_to_quiet_frame(array)
    wires.log.clear()
    return wires, array


def test_a_plausible_reading_is_read_once(foot: Foot) -> None:
    wires, array = foot
    array.scan_frame()
    assert [count_reads(wires, tile) for tile in range(4)] == [1] * 4


def test_a_disturbed_reading_is_read_three_times_and_the_majority_counts(foot: Foot) -> None:
    wires, array = foot
    expected = array.scan_frame().pressure_raw[1] + 1
    wires.log.clear()
    flip(wires, 1, 0x80)
    scan = array.scan_frame()
    assert scan.pressure_raw[1] == expected
    assert scan.tile_flags == [0, TileFlag.RETRIED, 0, 0]
    assert count_reads(wires, 1) == 3
    assert array.health[1].fault_counts["disturbed"] == 1


@pytest.mark.parametrize("bit", range(4, 10))
def test_a_bit_error_of_more_than_half_a_kilopascal_gives_no_reading(foot: Foot, bit: int) -> None:
    # A count is 0.1255 kPa (hardware.md 1.3): bits from 2^3 on are more than 0.5 kPa.
    wires, array = foot
    expected = array.scan_frame().pressure_raw[1] + 1
    flip(wires, 1, 1 << bit)
    scan = array.scan_frame()
    assert scan.pressure_raw[1] == expected or scan.tile_flags[1] & TileFlag.UNUSABLE


def test_three_different_readings_are_implausible(foot: Foot) -> None:
    wires, array = foot
    flip(wires, 1, 0x80, 0x100, 0x200)
    scan = array.scan_frame()
    assert scan.tile_flags[1] & TileFlag.IMPLAUSIBLE
    assert [scan.tile_flags[i] for i in (0, 2, 3)] == [0] * 3


def test_a_jump_that_is_read_twice_is_believed_at_once(foot: Foot) -> None:
    wires, array = foot
    before = array.scan_frame().pressure_raw[1]
    wires.log.clear()
    flip(wires, 1, later=0x40)  # and stays: 64 counts, 8 kPa in a frame
    scan = array.scan_frame()
    assert abs(scan.pressure_raw[1] - before) > 60
    assert scan.tile_flags == [0] * 4
    assert count_reads(wires, 1) == 2
    assert wires.log.count("60<04 60>8") == 1, "the tile that answers is identified"


def test_a_jump_to_the_counts_of_another_tile_shows_in_the_coefficients() -> None:
    wires, array = settled_on(FOUR, words={3: FORUM_CHIP})
    go_to_quiet_frame(array)
    array.scan_frame()
    # Channel 2 is wired to the fourth tile from now on.
    devices = dict(wires.muxes[0]._devices) | {1: wires.tiles[3]}
    wires.muxes[0]._devices = tuple(devices.items())
    wires.adapter._devices_by_routing.clear()
    scan = array.scan_frame()
    assert scan.tile_flags[1] & TileFlag.IMPLAUSIBLE
    for _ in range(20):
        assert array.scan_frame().tile_flags[1] & TileFlag.UNUSABLE


@pytest.mark.parametrize(
    ("counts", "flag"),
    [
        (b"\xff\xff\xff\xff", TileFlag.IMPLAUSIBLE),
        (b"\0\0\0\0", TileFlag.NOT_CONVERTED),
        (b"\x40\x00\xff\xc0", TileFlag.IMPLAUSIBLE),
    ],
)
def test_impossible_counts_are_flagged_in_their_frame_and_the_tile_is_identified(
    foot: Foot, counts: bytes, flag: TileFlag
) -> None:
    wires, array = foot
    is_disturbed = True

    def change(_: int, raw: list[int]) -> None:
        if is_disturbed:
            raw[:] = counts[: len(raw)]

    tamper(wires, 1, change)
    scan = array.scan_frame()
    assert scan.tile_flags == [0, flag, 0, 0]
    assert scan.pressure_raw[1] == int.from_bytes(counts[:2], "big") >> 6
    assert scan.temperature_raw[1] == int.from_bytes(counts[2:], "big") >> 6
    is_disturbed = False
    wires.log.clear()
    array.scan_frame()
    assert "60<04 60>8" in wires.log
    assert array.scan_frame().tile_flags == [0] * 4


# Conversion time

LONGEST_NS = 3_000_000  # MPL115A2 data sheet, table 10


class Monitored:
    """A monitor of the conversion times of four tiles."""

    def __init__(self, **how: Any) -> None:
        self.wires = Wires(FOUR, **how)
        self.clock = self.wires.clock
        self.ports = TileIo(self.wires.bus, self.wires.infos)
        self.health = [TileHealth(info) for info in self.wires.infos]
        timing = BusTiming(400_000, (TYPICAL_NS * 1e-9,) * 4, (0x70,) * 4)
        self.monitor = ConversionMonitor(self.ports, self.clock, self.health, timing)

    def test_tile(self, tile: int) -> bool:
        """Test a tile's conversion time; return whether it is slow."""
        self.ports.connect_tile(tile)
        self.monitor.test_conversion_time(tile)
        slow = self.health[tile].is_slow
        assert self.monitor.wait_ns[tile] == (LONGEST_NS if slow else TYPICAL_NS)
        return slow


def test_a_slow_part_has_the_longest_wait_as_long_as_it_is_slow() -> None:
    tiles = Monitored()
    with tiles.wires.fault("slow", "T03"):
        assert [tiles.test_tile(tile) for tile in range(4)] == [False, False, True, False]
    assert not tiles.test_tile(2)


def test_a_part_that_changes_its_reading_after_its_time_is_tested_once() -> None:
    tiles = Monitored()
    for change in ((0, 0), (1, 0), (0, 1)):
        tiles.ports.start_conversions([1])
        tiles.clock.sleep_until_ns(tiles.clock.now_ns() + TYPICAL_NS)
        pressure_raw, temperature_raw = tiles.ports.read_counts(1, with_temperature=True)
        earlier = pressure_raw - change[0], temperature_raw - change[1]
        for _ in range(2):
            tiles.monitor.check_read_in_time(1, earlier)
        assert tiles.monitor.pop_due_trial() == (1 if any(change) else None)
        assert tiles.monitor.pop_due_trial() is None


def test_a_slow_part_is_tested_again_every_half_second() -> None:
    tiles = Monitored()
    tested_ms = []
    with tiles.wires.fault("slow", "T03"):
        tiles.test_tile(2)
        begin_ns = tiles.clock.now_ns()
        for _ in range(2_500):
            tiles.clock.sleep_until_ns(tiles.clock.now_ns() + 1_000_000)
            if tiles.monitor.pop_due_trial() == 2:
                tested_ms.append((tiles.clock.now_ns() - begin_ns) // 1_000_000)
    assert len(tested_ms) in (4, 5)
    assert tested_ms[0] == pytest.approx(500, abs=2)


def test_the_conversion_time_of_a_silent_part_is_not_changed() -> None:
    tiles = Monitored()
    with tiles.wires.fault("no_answer", "T02"), pytest.raises(NoAcknowledgeError):
        tiles.test_tile(1)
    assert tiles.monitor.wait_ns == [TYPICAL_NS] * 4


@pytest.mark.parametrize("is_slow", [True, False])
def test_a_busy_machine_does_not_change_the_measured_conversion_time(is_slow: bool) -> None:
    for seed in range(30):
        tiles = Monitored(tc_ns=2_000_000 if is_slow else TYPICAL_NS)
        assert tiles.test_tile(2) == is_slow
        hesitating(tiles.wires, seed)
        for _ in range(20):
            assert tiles.test_tile(2) == is_slow


def test_a_machine_that_is_always_late_measures_nothing() -> None:
    tiles = Monitored()
    clock = tiles.clock
    tiles.wires.on_transaction = lambda _, __: clock.sleep_until_ns(clock.now_ns() + 500_000)
    for slow in (False, True):
        tiles.health[2].is_slow = slow
        tiles.ports.connect_tile(2)
        tiles.monitor.test_conversion_time(2)
        assert tiles.health[2].is_slow == slow
