"""The emulated wires, asked by a reader that has never seen our drivers: smbus2 messages alone.

What is expected comes from hardware.md 1 to 4; SCL periods per transaction from its section 4.
"""

from __future__ import annotations

import errno
from collections.abc import Callable, Iterable
from functools import partial, reduce
from operator import and_

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from smbus2 import i2c_msg

from devices.clock import VirtualClock
from devices.emulation.buses.i2c import EmulatedI2cAdapter
from devices.emulation.chips.mpl115a2 import EmulatedMpl115a2, Silicon
from devices.emulation.chips.tca9548a import EmulatedTca9548a
from devices.scene.emulation import ReadDuringConversion

MUX, OTHER_MUX, TILE = 0x70, 0x71, 0x60
TC_NS = 1_600_000
DATA_SHEET = (0x3ECE, 0xB3F9, 0xC517, 0x33C8)
FORUM = (0x3591, 0xC0A2, 0xC625, 0x2C18)


def chip(
    *results: tuple[int, int],
    words: tuple[int, int, int, int] = DATA_SHEET,
    mode: ReadDuringConversion = "stale",
) -> EmulatedMpl115a2:
    """A part whose conversions give `results`, one after another."""
    coming = iter(results)
    return EmulatedMpl115a2(Silicon(words, TC_NS, lambda _: next(coming)), mode)


class Reader:
    """What somebody with smbus2 and the data sheets would write."""

    def __init__(
        self, muxes: dict[int, dict[int, EmulatedMpl115a2]], scl_hz: float = 400_000
    ) -> None:
        self.clock = VirtualClock(5_000_000_000)
        self.muxes = [EmulatedTca9548a(address, tiles) for address, tiles in muxes.items()]
        self.adapter = EmulatedI2cAdapter(self.muxes, self.clock, scl_hz)

    def select(self, mask: int, mux: int = MUX) -> None:
        self.adapter.i2c_rdwr(i2c_msg.write(mux, [mask]))

    def selected(self, mux: int = MUX) -> int:
        message = i2c_msg.read(mux, 1)
        self.adapter.i2c_rdwr(message)
        return bytes(message)[0]

    def convert(self) -> None:
        self.adapter.i2c_rdwr(i2c_msg.write(TILE, [0x12, 0x00]))

    def convert_and_wait(self) -> None:
        self.convert()
        self.wait(TC_NS)

    def wait(self, t_ns: int) -> None:
        self.clock.sleep_until_ns(self.clock.now_ns() + t_ns)

    def read(self, register: int, count: int) -> bytes:
        message = i2c_msg.read(TILE, count)
        self.adapter.i2c_rdwr(i2c_msg.write(TILE, [register]), message)
        return bytes(message)

    def words(self) -> tuple[int, int, int, int]:
        raw = self.read(0x04, 8)
        a0, b1, b2, c12 = (raw[i] << 8 | raw[i + 1] for i in range(0, 8, 2))
        return a0, b1, b2, c12

    def counts(self) -> tuple[int, int]:
        raw = self.read(0x00, 4)
        return (raw[0] << 8 | raw[1]) >> 6, (raw[2] << 8 | raw[3]) >> 6


def alone(part: EmulatedMpl115a2, scl_hz: float = 400_000) -> Reader:
    """One tile on channel 0, selected."""
    reader = Reader({MUX: {0: part}}, scl_hz)
    reader.select(0b1)
    return reader


def refusal(transact: Callable[[], object]) -> int | None:
    with pytest.raises(OSError) as caught:  # noqa: PT011  # the number is what it is about
        transact()
    assert type(caught.value) is OSError, "the kernel knows nothing of our errors"
    return caught.value.errno


# The multiplexer


def test_at_power_up_no_tile_is_connected() -> None:
    reader = Reader({MUX: {0: chip()}})
    assert refusal(lambda: reader.read(0x04, 8)) == 121
    assert reader.selected() == 0


def test_a_select_takes_effect_only_after_the_stop() -> None:
    reader = Reader({MUX: {0: chip(words=DATA_SHEET), 1: chip(words=FORUM)}})
    reader.select(0b01)
    answer = i2c_msg.read(TILE, 8)
    # Select and access joined by repeated STARTs: the access still goes to the old channel.
    reader.adapter.i2c_rdwr(i2c_msg.write(MUX, [0b10]), i2c_msg.write(TILE, [0x04]), answer)
    assert bytes(answer).hex() == "3eceb3f9c51733c8"
    assert reader.words() == FORUM


def test_a_select_before_which_nothing_was_open_finds_nobody_in_the_same_transaction() -> None:
    reader = Reader({MUX: {0: chip()}})
    joined = (i2c_msg.write(MUX, [1]), i2c_msg.write(TILE, [0x04]), i2c_msg.read(TILE, 8))
    assert refusal(lambda: reader.adapter.i2c_rdwr(*joined)) == 121
    # The STOP behind the missing acknowledge brings it into force all the same.
    assert reader.words() == DATA_SHEET


def test_a_convert_joined_to_a_select_goes_to_the_old_tile() -> None:
    reader = Reader({MUX: {0: chip((410, 507)), 1: chip((272, 521))}})
    reader.select(0b01)
    reader.adapter.i2c_rdwr(i2c_msg.write(MUX, [0b10]), i2c_msg.write(TILE, [0x12, 0]))
    reader.wait(2 * TC_NS)
    assert reader.counts() == (0, 0), "the newly selected tile never converted"
    reader.select(0b01)
    assert reader.counts() == (410, 507)


def test_a_select_and_a_deselect_in_one_transaction_leave_the_last_word() -> None:
    reader = Reader({MUX: {0: chip(), 1: chip(words=FORUM)}})
    reader.adapter.i2c_rdwr(i2c_msg.write(MUX, [0b01]), i2c_msg.write(MUX, [0b10]))
    assert reader.words() == FORUM


def test_of_several_bytes_to_a_mux_the_last_one_counts() -> None:
    reader = Reader({MUX: {0: chip(), 3: chip(words=FORUM)}})
    # As SMBus write_byte_data does it: a register number first, which the part does not have.
    reader.adapter.i2c_rdwr(i2c_msg.write(MUX, [0b0000_0001, 0b0000_0010, 0b0000_1000]))
    assert reader.selected() == 0b0000_1000
    assert reader.words() == FORUM


def test_an_empty_write_to_a_mux_finds_it_and_changes_nothing() -> None:
    reader = Reader({MUX: {0: chip()}})
    reader.select(1)
    reader.adapter.i2c_rdwr(i2c_msg.write(MUX, []))
    assert reader.selected() == 1
    assert reader.words() == DATA_SHEET


@settings(max_examples=50)
@given(mask=st.integers(0, 255))
def test_any_combination_of_channels_can_be_set_and_read_back(mask: int) -> None:
    reader = Reader({MUX: {}})
    reader.select(mask)
    assert reader.selected() == mask


def test_a_mux_is_reached_whatever_its_channels_are() -> None:
    reader = Reader({MUX: {0: chip()}, OTHER_MUX: {}})
    reader.select(0xFF)
    reader.select(0x81, mux=OTHER_MUX)
    assert (reader.selected(), reader.selected(OTHER_MUX)) == (0xFF, 0x81)


def test_a_mux_that_is_not_fitted_does_not_answer() -> None:
    reader = Reader({MUX: {}})
    assert refusal(lambda: reader.select(1, mux=OTHER_MUX)) == 121


# Conversions


def test_right_after_power_up_both_words_are_zero() -> None:
    assert alone(chip((410, 507))).counts() == (0, 0)


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
    reader.wait(TC_NS * 3 // 4)
    assert reader.counts() == (272, 507)
    reader.wait(TC_NS)
    assert reader.counts() == (272, 521)


def test_in_mode_torn_a_read_before_the_pressure_is_there_finds_the_previous_result() -> None:
    reader = alone(chip((410, 507), (272, 521), mode="torn"))
    reader.convert_and_wait()
    reader.convert()
    assert reader.counts() == (410, 507)


@pytest.mark.parametrize("mode", ["stale", "abort", "torn"])
def test_a_reader_that_waits_sees_no_difference_between_the_modes(
    mode: ReadDuringConversion,
) -> None:
    reader = alone(chip((410, 507), (272, 521), mode=mode))
    for expected in ((410, 507), (272, 521)):
        reader.convert_and_wait()
        assert reader.counts() == expected
        assert reader.counts() == expected


@pytest.mark.parametrize("value", [0x00, 0x01, 0xFF])
def test_convert_takes_any_data_byte(value: int) -> None:
    reader = alone(chip((410, 507)))
    reader.adapter.i2c_rdwr(i2c_msg.write(TILE, [0x12, value]))
    reader.wait(TC_NS)
    assert reader.counts() == (410, 507)


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


@given(first=st.integers(0x00, 0x0B), count=st.integers(1, 8))
def test_the_register_address_moves_on_by_itself(first: int, count: int) -> None:
    reader = alone(chip((410, 507)))
    reader.convert_and_wait()
    whole = bytes.fromhex("6680 7ec0 3ece b3f9 c517 33c8") + bytes(8)
    assert reader.read(first, count) == whole[first : first + count]


def test_a_stop_between_register_address_and_read_does_no_harm() -> None:
    reader = alone(chip())
    reader.adapter.i2c_rdwr(i2c_msg.write(TILE, [0x04]))
    answer = i2c_msg.read(TILE, 8)
    reader.adapter.i2c_rdwr(answer)
    assert bytes(answer) == bytes.fromhex("3eceb3f9c51733c8")


def test_a_write_to_a_read_only_register_is_acknowledged_and_ignored() -> None:
    reader = alone(chip())
    reader.adapter.i2c_rdwr(i2c_msg.write(TILE, [0x04, 0x00, 0x00, 0x00]))
    assert reader.words() == DATA_SHEET


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
    reader = Reader({MUX: {0: chip((410, 507)), 5: chip((272, 521), words=FORUM)}})
    reader.select(0b10_0001)
    reader.convert_and_wait()
    assert reader.counts() == (410 & 272, 507 & 521)
    assert reader.words() == (0x3ECE & 0x3591, 0xB3F9 & 0xC0A2, 0xC517 & 0xC625, 0x33C8 & 0x2C18)


def test_two_muxes_left_open_read_as_the_bitwise_and() -> None:
    reader = Reader({MUX: {0: chip()}, OTHER_MUX: {7: chip(words=FORUM)}})
    reader.select(0x01)
    reader.select(0x80, mux=OTHER_MUX)  # and forgets to close the one it leaves
    assert reader.words() == (0x3480, 0x80A0, 0xC405, 0x2008)
    reader.select(0x00)
    assert reader.words() == FORUM


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
    part.start = lambda reading, t_ns: False  # type: ignore[method-assign]  # for this part only
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
        self.mask = 0
        self.heard: list[int | str] = []
        self._acknowledges = iter(acknowledges)

    def start(self, reading: bool, t_ns: int) -> bool:
        self.heard.append("read" if reading else "write")
        return True

    def write(self, value: int) -> bool:
        self.heard.append(value)
        return next(self._acknowledges, True)

    def read(self, count: int) -> bytes:
        return b"\xff" * count

    def stop(self, t_ns: int) -> None:
        self.heard.append("stop")

    def connected(self) -> Iterable[Port]:
        return ()

    def suffer(self, t_ns: int) -> None:
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


# What a Raspberry Pi's adapter refuses


def write() -> i2c_msg:
    return i2c_msg.write(TILE, [0x00])


def read() -> i2c_msg:
    return i2c_msg.read(TILE, 4)


def convert() -> i2c_msg:
    return i2c_msg.write(TILE, [0x12, 0x00])


@pytest.mark.parametrize(
    "messages",
    [
        [write, read, write, read],
        [write, read, convert],
        [read, write],
        [read, read],
    ],
    ids=["W R W R", "W R W", "R W", "R R"],
)
def test_only_one_read_is_allowed_and_it_must_be_last(
    messages: list[Callable[[], i2c_msg]],
) -> None:
    reader = alone(chip((410, 507)))
    before_ns = reader.clock.now_ns()
    assert refusal(lambda: reader.adapter.i2c_rdwr(*(make() for make in messages))) == 95
    assert reader.clock.now_ns() == before_ns, "refused before it touches the bus"


def test_several_writes_may_come_before_the_read() -> None:
    reader = alone(chip((410, 507)))
    answer = read()
    reader.adapter.i2c_rdwr(convert(), write(), answer)
    assert bytes(answer) == bytes(4)
    reader.wait(TC_NS)
    assert reader.counts() == (410, 507)


def test_more_than_42_messages_are_refused() -> None:
    reader = alone(chip())
    reader.adapter.i2c_rdwr(*(write() for _ in range(42)))
    before_ns = reader.clock.now_ns()
    assert refusal(lambda: reader.adapter.i2c_rdwr(*(write() for _ in range(43)))) == 22
    assert reader.clock.now_ns() == before_ns


def test_no_message_at_all_is_refused() -> None:
    assert refusal(alone(chip()).adapter.i2c_rdwr) == errno.EINVAL


def test_a_message_of_more_than_8192_bytes_is_refused() -> None:
    adapter = alone(chip()).adapter
    adapter.i2c_rdwr(i2c_msg.read(TILE, 8192))
    assert refusal(lambda: adapter.i2c_rdwr(i2c_msg.read(TILE, 8193))) == errno.EINVAL


@pytest.mark.parametrize("address", [0x00, 0x5F, 0x61, 0x6F, 0x78])
def test_nobody_answers_at_another_address_nor_at_the_general_call(address: int) -> None:
    reader = Reader({MUX: {0: chip((410, 507))}, OTHER_MUX: {}})
    reader.select(1)
    for message in (i2c_msg.write(address, [0x12, 0]), i2c_msg.read(address, 1)):
        assert refusal(partial(reader.adapter.i2c_rdwr, message)) == 121
    reader.wait(TC_NS)
    assert reader.counts() == (0, 0)


def test_a_missing_acknowledge_lets_what_came_before_it_happen() -> None:
    reader = alone(chip((410, 507)))
    joined = (convert(), i2c_msg.write(0x61, [0]))
    assert refusal(lambda: reader.adapter.i2c_rdwr(*joined)) == 121
    reader.wait(TC_NS)
    assert reader.counts() == (410, 507)


# Time on the bus, in SCL periods (hardware.md 4)

PERIODS = [
    ("mux select", lambda: [i2c_msg.write(MUX, [1])], 20),
    ("mux read-back", lambda: [i2c_msg.read(MUX, 1)], 20),
    ("convert", lambda: [convert()], 29),
    ("read pressure", lambda: [write(), i2c_msg.read(TILE, 2)], 48),
    ("read both", lambda: [write(), read()], 66),
    ("read coefficients", lambda: [i2c_msg.write(TILE, [4]), i2c_msg.read(TILE, 8)], 102),
    ("restart and read", lambda: [convert(), write(), read()], 94),
]


@pytest.mark.parametrize(("scl_hz", "ns_per_period"), [(400_000, 2_500), (250_000, 4_000)])
@pytest.mark.parametrize(("_what", "messages", "periods"), PERIODS, ids=[p[0] for p in PERIODS])
def test_a_transaction_takes_its_scl_periods_to_the_nanosecond(
    _what: str,
    messages: Callable[[], list[i2c_msg]],
    periods: int,
    scl_hz: float,
    ns_per_period: int,
) -> None:
    reader = alone(chip((410, 507)), scl_hz)
    before_ns = reader.clock.now_ns()
    reader.adapter.i2c_rdwr(*messages())
    assert reader.clock.now_ns() - before_ns == periods * ns_per_period


@pytest.mark.parametrize(("scl_hz", "ns_per_period"), [(400_000, 2_500), (250_000, 4_000)])
def test_an_address_that_is_not_acknowledged_takes_11_periods(
    scl_hz: float, ns_per_period: int
) -> None:
    reader = Reader({MUX: {0: chip()}}, scl_hz)
    before_ns = reader.clock.now_ns()
    assert refusal(reader.convert) == 121
    assert reader.clock.now_ns() - before_ns == 11 * ns_per_period


def test_a_conversion_begins_at_the_stop_of_its_convert() -> None:
    sampled_ns: list[int] = []

    def sense(t_ns: int) -> tuple[int, int]:
        sampled_ns.append(t_ns)
        return 410, 507

    reader = alone(EmulatedMpl115a2(Silicon(DATA_SHEET, TC_NS, sense)))
    begin_ns = reader.clock.now_ns()
    reader.convert()
    # 29 periods of 2.5 us to the STOP; sampled a quarter into the conversion (hardware.md 1.4)
    assert sampled_ns == [begin_ns + 72_500 + TC_NS // 4]
