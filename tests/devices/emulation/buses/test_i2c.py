"""The emulated wires, asked by a reader that has never seen our drivers: smbus2 messages alone.

What is expected comes from hardware.md 1 to 4; SCL periods per transaction from its section 4.
"""

from __future__ import annotations

import errno
from collections.abc import Iterable
from functools import reduce
from operator import and_

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from smbus2 import i2c_msg

from devices.clock import VirtualClock
from devices.emulation.chips.mpl115a2 import EmulatedMpl115a2
from devices.emulation.i2c_bus import EmulatedI2cAdapter
from devices.scene.emulation_sections import ReadDuringConversion
from tests.builders.arrays import DATA_SHEET_CHIP, FORUM_CHIP
from tests.devices.emulation.buses.readers import (
    MUX,
    OTHER_MUX,
    TC_NS,
    TILE,
    Reader,
    alone,
    chip,
    refusal,
)

# The multiplexer


def test_at_power_up_no_tile_is_connected() -> None:
    reader = Reader({MUX: {0: chip()}})
    assert refusal(lambda: reader.read(0x04, 8)) == 121
    assert reader.selected() == 0


def test_a_select_takes_effect_only_after_the_stop() -> None:
    reader = Reader({MUX: {0: chip(words=DATA_SHEET_CHIP), 1: chip(words=FORUM_CHIP)}})
    reader.select(0b01)
    answer = i2c_msg.read(TILE, 8)
    # Select and access joined by repeated STARTs: the access still goes to the old channel.
    reader.adapter.i2c_rdwr(i2c_msg.write(MUX, [0b10]), i2c_msg.write(TILE, [0x04]), answer)
    assert bytes(answer).hex() == "3eceb3f9c51733c8"
    assert reader.words() == FORUM_CHIP


def test_a_select_before_which_nothing_was_open_finds_nobody_in_the_same_transaction() -> None:
    reader = Reader({MUX: {0: chip()}})
    joined = (i2c_msg.write(MUX, [1]), i2c_msg.write(TILE, [0x04]), i2c_msg.read(TILE, 8))
    assert refusal(lambda: reader.adapter.i2c_rdwr(*joined)) == 121
    # The STOP behind the missing acknowledge brings it into force all the same.
    assert reader.words() == DATA_SHEET_CHIP


def test_a_convert_joined_to_a_select_goes_to_the_old_tile() -> None:
    reader = Reader({MUX: {0: chip((410, 507)), 1: chip((272, 521))}})
    reader.select(0b01)
    reader.adapter.i2c_rdwr(i2c_msg.write(MUX, [0b10]), i2c_msg.write(TILE, [0x12, 0]))
    reader.wait(2 * TC_NS)
    assert reader.counts() == (0, 0), "the newly selected tile never converted"
    reader.select(0b01)
    assert reader.counts() == (410, 507)


def test_a_select_and_a_deselect_in_one_transaction_leave_the_last_word() -> None:
    reader = Reader({MUX: {0: chip(), 1: chip(words=FORUM_CHIP)}})
    reader.adapter.i2c_rdwr(i2c_msg.write(MUX, [0b01]), i2c_msg.write(MUX, [0b10]))
    assert reader.words() == FORUM_CHIP


def test_of_several_bytes_to_a_mux_the_last_one_counts() -> None:
    reader = Reader({MUX: {0: chip(), 3: chip(words=FORUM_CHIP)}})
    # As SMBus write_byte_data does it: a register number first, which the part does not have.
    reader.adapter.i2c_rdwr(i2c_msg.write(MUX, [0b0000_0001, 0b0000_0010, 0b0000_1000]))
    assert reader.selected() == 0b0000_1000
    assert reader.words() == FORUM_CHIP


def test_an_empty_write_to_a_mux_finds_it_and_changes_nothing() -> None:
    reader = Reader({MUX: {0: chip()}})
    reader.select(1)
    reader.adapter.i2c_rdwr(i2c_msg.write(MUX, []))
    assert reader.selected() == 1
    assert reader.words() == DATA_SHEET_CHIP


def test_a_mux_is_reached_whatever_its_channels_are() -> None:
    reader = Reader({MUX: {0: chip()}, OTHER_MUX: {}})
    reader.select(0xFF)
    reader.select(0x81, mux=OTHER_MUX)
    assert (reader.selected(), reader.selected(OTHER_MUX)) == (0xFF, 0x81)


def test_a_mux_that_is_not_fitted_does_not_answer() -> None:
    reader = Reader({MUX: {}})
    assert refusal(lambda: reader.select(1, mux=OTHER_MUX)) == 121


# Conversions


def test_a_reader_that_does_not_wait_gets_the_previous_result() -> None:
    reader = alone(chip((410, 507), (272, 521), (1023, 1)))
    reader.convert()
    assert reader.counts() == (0, 0)
    reader.wait(TC_NS)
    assert reader.counts() == (410, 507)
    reader.convert()
    reader.wait(TC_NS - 200_000)
    assert reader.counts() == (410, 507)
    reader.wait(200_000)
    assert reader.counts() == (272, 521)


def test_a_result_stays_until_the_next_one() -> None:
    reader = alone(chip((410, 507)))
    reader.convert_and_wait()
    reader.wait(60_000_000_000)
    assert [reader.counts() for _ in range(3)] == [(410, 507)] * 3


def test_in_mode_abort_a_read_loses_the_conversion() -> None:
    reader = alone(chip((410, 507), (272, 521), (300, 500), mode="abort"))
    reader.convert_and_wait()
    reader.convert()
    assert reader.counts() == (410, 507)
    reader.wait(10 * TC_NS)
    assert reader.counts() == (410, 507), "the conversion should be lost"
    reader.convert_and_wait()
    assert reader.counts() == (300, 500), "the next one should be whole"


def test_in_mode_torn_a_read_finds_the_new_pressure_beside_the_old_temperature() -> None:
    reader = alone(chip((410, 507), (272, 521), mode="torn"))
    reader.convert_and_wait()
    reader.convert()
    assert reader.counts() == (410, 507), "before the pressure is there: the previous result"
    reader.wait(TC_NS * 3 // 4)
    assert reader.counts() == (272, 507)
    reader.wait(TC_NS)
    assert reader.counts() == (272, 521)


@pytest.mark.parametrize("mode", ["stale", "abort", "torn"])
def test_a_reader_that_waits_sees_no_difference_between_the_modes(
    mode: ReadDuringConversion,
) -> None:
    reader = alone(chip((410, 507), (272, 521), mode=mode))
    for expected in ((410, 507), (272, 521)):
        reader.convert_and_wait()
        assert reader.counts() == expected
        assert reader.counts() == expected


def test_a_convert_without_its_data_byte_is_not_relied_on() -> None:
    reader = alone(chip((410, 507)))
    reader.adapter.i2c_rdwr(i2c_msg.write(TILE, [0x12]))
    reader.wait(2 * TC_NS)
    assert reader.counts() == (0, 0)


def test_reading_register_0x12_starts_nothing() -> None:
    reader = alone(chip((410, 507)))
    reader.read(0x12, 2)
    reader.wait(2 * TC_NS)
    assert reader.counts() == (0, 0)


# Registers


def test_the_registers_are_those_of_the_data_sheet() -> None:
    reader = alone(chip((410, 507)))
    reader.convert_and_wait()
    # 410 and 507 left-justified are 6680 and 7EC0 (hardware.md 1.2); 0C to 0F are always zero
    assert reader.read(0x00, 16).hex(" ") == "66 80 7e c0 3e ce b3 f9 c5 17 33 c8 00 00 00 00"


def test_the_top_bit_of_a_register_address_does_not_matter() -> None:
    reader = alone(chip((410, 507)))
    reader.adapter.i2c_rdwr(i2c_msg.write(TILE, [0x92, 0x00]))
    reader.wait(TC_NS)
    assert reader.read(0x80, 4) == reader.read(0x00, 4) == bytes.fromhex("66807ec0")
    assert reader.read(0x84, 8) == bytes.fromhex("3eceb3f9c51733c8")


def test_a_stop_between_register_address_and_read_does_no_harm() -> None:
    reader = alone(chip())
    reader.adapter.i2c_rdwr(i2c_msg.write(TILE, [0x04]))
    answer = i2c_msg.read(TILE, 8)
    reader.adapter.i2c_rdwr(answer)
    assert bytes(answer) == bytes.fromhex("3eceb3f9c51733c8")


def test_a_write_to_a_read_only_register_is_acknowledged_and_ignored() -> None:
    reader = alone(chip())
    reader.adapter.i2c_rdwr(i2c_msg.write(TILE, [0x04, 0x00, 0x00, 0x00]))
    assert reader.words() == DATA_SHEET_CHIP


def test_a_message_object_can_be_used_again() -> None:
    reader = alone(chip((410, 507), (272, 521)))
    point, answer = i2c_msg.write(TILE, [0x00]), i2c_msg.read(TILE, 2)
    seen = []
    for _ in range(2):
        reader.convert_and_wait()
        reader.adapter.i2c_rdwr(point, answer)
        seen.append(bytes(answer))
    assert seen == [bytes.fromhex("6680"), bytes.fromhex("4400")]


# Open drain


def test_two_open_channels_read_as_the_bitwise_and() -> None:
    reader = Reader({MUX: {0: chip((410, 507)), 5: chip((272, 521), words=FORUM_CHIP)}})
    reader.select(0b10_0001)
    reader.convert_and_wait()
    assert reader.counts() == (410 & 272, 507 & 521)
    assert reader.words() == (0x3ECE & 0x3591, 0xB3F9 & 0xC0A2, 0xC517 & 0xC625, 0x33C8 & 0x2C18)


def test_two_muxes_left_open_read_as_the_bitwise_and() -> None:
    reader = Reader({MUX: {0: chip()}, OTHER_MUX: {7: chip(words=FORUM_CHIP)}})
    reader.select(0x01)
    reader.select(0x80, mux=OTHER_MUX)  # and forgets to close the one it leaves
    assert reader.words() == (0x3480, 0x80A0, 0xC405, 0x2008)
    reader.select(0x00)
    assert reader.words() == FORUM_CHIP


plugs = st.tuples(st.sampled_from([MUX, OTHER_MUX]), st.integers(0, 7))
words16 = st.tuples(*[st.integers(0, 0xFFFF)] * 4)


@settings(max_examples=50)
@given(
    tiles=st.dictionaries(plugs, words16, max_size=8),
    mask=st.integers(0, 255),
    other_mask=st.integers(0, 255),
)
def test_whatever_is_open_is_heard_at_once_and_nothing_else(
    tiles: dict[tuple[int, int], tuple[int, int, int, int]], mask: int, other_mask: int
) -> None:
    masks = {MUX: mask, OTHER_MUX: other_mask}
    reader = Reader(
        {
            mux: {c: chip(words=words) for (m, c), words in tiles.items() if m == mux}
            for mux in masks
        }
    )
    for mux, value in masks.items():
        reader.select(value, mux)
    open_words = [words for (mux, channel), words in tiles.items() if masks[mux] >> channel & 1]
    if open_words:
        columns = zip(*open_words, strict=True)
        assert reader.words() == tuple(reduce(and_, column) for column in columns)
    else:
        assert refusal(reader.words) == 121


def test_a_broadcast_convert_reaches_all_open_tiles() -> None:
    reader = Reader({MUX: {0: chip((410, 507)), 1: chip((272, 521))}, OTHER_MUX: {0: chip((1, 2))}})
    reader.select(0b11)
    reader.select(0b1, mux=OTHER_MUX)
    reader.convert_and_wait()
    seen = []
    for mask, other_mask in ((1, 0), (2, 0), (0, 1)):
        reader.select(mask)
        reader.select(other_mask, mux=OTHER_MUX)
        seen.append(reader.counts())
    assert seen == [(410, 507), (272, 521), (1, 2)]


def silent(part: EmulatedMpl115a2) -> EmulatedMpl115a2:
    part.on_address = lambda reading, t_ns: False  # type: ignore[method-assign]  # for this part only
    return part


def test_a_broadcast_is_acknowledged_if_any_tile_acknowledges() -> None:
    reader = Reader({MUX: {0: silent(chip()), 1: chip((410, 507)), 2: silent(chip())}})
    reader.select(0b111)
    reader.convert_and_wait()  # the missing tiles do not show
    assert reader.counts() == (410, 507)
    for mask in (0b001, 0b100, 0b101):
        reader.select(mask)
        assert refusal(reader.convert) == 121


class Port:
    """Any device; notes what it hears, acknowledges as it is told, gives ones."""

    def __init__(self, address: int, acknowledges: Iterable[bool] = ()) -> None:
        self.address = address
        self.connected_mask = 0
        self.heard: list[int | str] = []
        self._acknowledges = iter(acknowledges)

    def on_address(self, reading: bool, t_ns: int) -> bool:
        self.heard.append("read" if reading else "write")
        return True

    def receive_byte(self, value: int) -> bool:
        self.heard.append(value)
        return next(self._acknowledges, True)

    def send_bytes(self, count: int) -> bytes:
        return b"\xff" * count

    def on_stop(self, t_ns: int) -> None:
        self.heard.append("stop")

    def interrupt_supply(self) -> None:
        pass

    def get_connected_devices(self) -> Iterable[Port]:
        return ()

    def apply_faults(self, t_ns: int) -> None:
        pass

    def reset(self) -> None:
        self.heard.append("reset")


def test_a_data_byte_that_is_not_acknowledged_ends_the_transaction() -> None:
    clock = VirtualClock()
    port = Port(0x20, acknowledges=[True, False])
    adapter = EmulatedI2cAdapter([port], clock, 400_000)
    assert refusal(lambda: adapter.i2c_rdwr(i2c_msg.write(0x20, [1, 2, 3]))) == errno.EREMOTEIO
    assert port.heard == ["write", 1, 2, "stop"]
    assert clock.now_ns() == (10 + 9 + 9 + 1) * 2_500


def test_a_data_byte_is_acknowledged_if_any_device_acknowledges_it() -> None:
    ports = [Port(0x20, [False, True]), Port(0x20, [True, False])]
    adapter = EmulatedI2cAdapter(ports, VirtualClock(), 400_000)
    adapter.i2c_rdwr(i2c_msg.write(0x20, [1, 2]))
    assert [port.heard for port in ports] == [["write", 1, 2, "stop"]] * 2
