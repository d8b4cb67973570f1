"""Is a reading to be believed? What looks doubtful is asked for again before it is passed on."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from devices.array.tile_array import TileArray
from devices.flags import TileFlag
from tests.builders.arrays import FORUM_CHIP
from tests.devices.rigs import FOUR, LOOK_FRAMES, Wires, settled_on

Tamper = Callable[[int, list[int]], None]


def read_bytes(wires: Wires, tile: int, tamper: Tamper) -> None:
    """Let `tamper` change the data bytes of a tile's readings, told their number."""
    part = wires.tiles[tile]
    true_read, count = part.send_bytes, iter(range(10_000))

    def read(n_bytes: int) -> bytes:
        raw = list(true_read(n_bytes))
        if n_bytes in (2, 4):
            tamper(next(count), raw)
        return bytes(raw)

    part.send_bytes = read  # type: ignore[method-assign,assignment]  # for this part only


def quiet_frame(array: TileArray) -> None:
    """Go on to a frame after which none is near in which somebody is read once more."""
    while array._frame_index % LOOK_FRAMES not in (2, 3):
        array.scan_frame()


def reads_of(wires: Wires, tile: int) -> int:
    """How often this tile was read in what the log holds."""
    mask = f"70<{1 << tile:02x}"
    connected, reads = "", 0
    for entry in wires.log:
        if entry.startswith("70<"):
            connected = entry
        reads += entry.startswith("60<00") and connected == mask
    return reads


@pytest.fixture
def foot() -> tuple[Wires, TileArray]:
    wires, array = settled_on(FOUR)
    quiet_frame(array)
    wires.log.clear()
    return wires, array


def test_a_plain_reading_is_read_once(foot: tuple[Wires, TileArray]) -> None:
    wires, array = foot
    array.scan_frame()
    assert [reads_of(wires, tile) for tile in range(4)] == [1] * 4


def test_a_disturbed_reading_is_read_three_times_and_the_majority_passed_on(
    foot: tuple[Wires, TileArray],
) -> None:
    wires, array = foot
    expected = array.scan_frame().pressure_raw[1] + 1
    wires.log.clear()

    def tamper(count: int, raw: list[int]) -> None:
        raw[0] ^= 0x20 if count == 0 else 0

    read_bytes(wires, 1, tamper)
    scan = array.scan_frame()
    assert scan.pressure_raw[1] == expected
    assert scan.tile_flags == [0, TileFlag.RETRIED, 0, 0]
    assert reads_of(wires, 1) == 3
    assert array.health[1].fault_counts["disturbed"] == 1


@pytest.mark.parametrize("bit", range(4, 10))
def test_no_bit_error_of_more_than_half_a_kilopascal_is_passed_on(
    foot: tuple[Wires, TileArray], bit: int
) -> None:
    # A count is 0.1255 kPa (hardware.md 1.3): bits from 2^3 on are more than 0.5 kPa.
    wires, array = foot
    expected = array.scan_frame().pressure_raw[1] + 1

    def tamper(count: int, raw: list[int]) -> None:
        if count == 0:
            word = (raw[0] << 8 | raw[1]) ^ 1 << bit + 6
            raw[0], raw[1] = word >> 8, word & 0xFF

    read_bytes(wires, 1, tamper)
    scan = array.scan_frame()
    assert scan.pressure_raw[1] == expected or scan.tile_flags[1] & TileFlag.UNUSABLE


def test_three_readings_that_all_differ_are_none(foot: tuple[Wires, TileArray]) -> None:
    wires, array = foot

    def tamper(count: int, raw: list[int]) -> None:
        raw[0] ^= (0x20, 0x40, 0x80)[count] if count < 3 else 0

    read_bytes(wires, 1, tamper)
    scan = array.scan_frame()
    assert scan.tile_flags[1] & TileFlag.IMPLAUSIBLE
    assert [scan.tile_flags[i] for i in (0, 2, 3)] == [0] * 3


def test_a_true_jump_is_believed_at_once_if_it_comes_twice(foot: tuple[Wires, TileArray]) -> None:
    wires, array = foot

    def tamper(_: int, raw: list[int]) -> None:
        raw[0] ^= 0x10  # stays: 64 counts, 8 kPa in a frame

    before = array.scan_frame().pressure_raw[1]
    wires.log.clear()
    read_bytes(wires, 1, tamper)
    scan = array.scan_frame()
    assert abs(scan.pressure_raw[1] - before) > 60
    assert scan.tile_flags == [0] * 4
    assert reads_of(wires, 1) == 2
    assert wires.log.count("60<04 60>8") == 1, "is it this tile that answers?"


def test_a_jump_that_is_another_tiles_word_is_noticed_by_its_coefficients() -> None:
    wires, array = settled_on(FOUR, words={3: FORUM_CHIP})
    quiet_frame(array)
    array.scan_frame()
    # Channel 2 is wired to the fourth tile from now on.
    wires.muxes[0]._channels[1] = wires.tiles[3]
    wires.adapter._devices_by_routing.clear()
    scan = array.scan_frame()
    assert scan.tile_flags[1] & TileFlag.IMPLAUSIBLE
    for _ in range(20):
        assert array.scan_frame().tile_flags[1] & TileFlag.UNUSABLE


@pytest.mark.parametrize(
    ("raw", "status"),
    [
        (b"\xff\xff\xff\xff", TileFlag.IMPLAUSIBLE),
        (b"\0\0\0\0", TileFlag.NOT_CONVERTED),
        (b"\x40\x00\xff\xc0", TileFlag.IMPLAUSIBLE),
    ],
)
def test_words_that_no_part_gives_are_flagged_in_their_own_frame_and_the_tile_looked_at(
    foot: tuple[Wires, TileArray], raw: bytes, status: TileFlag
) -> None:
    wires, array = foot
    there = [True]

    def tamper(_: int, given: list[int]) -> None:
        if there:
            given[:] = raw[: len(given)]

    read_bytes(wires, 1, tamper)
    assert array.scan_frame().tile_flags == [0, status, 0, 0]
    there.clear()
    wires.log.clear()
    array.scan_frame()
    assert "60<04 60>8" in wires.log
    assert array.scan_frame().tile_flags == [0] * 4
