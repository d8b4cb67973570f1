"""The emulated I2C bus, by smbus2 messages alone, and the emulated TCA9548A by itself.

Expected values come from hardware.md 1 to 4, SCL periods per transaction from its section 4.
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
from devices.emulation.chips.mpl115a2 import EmulatedMpl115a2, Mpl115a2Part
from devices.emulation.chips.tca9548a import EmulatedTca9548a
from devices.emulation.fault_timing import FaultTiming
from devices.emulation.i2c_bus import EmulatedI2cAdapter
from tests.builders.arrays import DATA_SHEET_CHIP, FORUM_CHIP

MUX, OTHER_MUX, TILE = 0x70, 0x71, 0x60
TC_NS = 1_600_000

Words = tuple[int, int, int, int]


def part(counts: tuple[int, int] = (410, 507), words: Words = DATA_SHEET_CHIP) -> EmulatedMpl115a2:
    return EmulatedMpl115a2(Mpl115a2Part(words, TC_NS, lambda _: counts))


def select(mask: int, mux: int = MUX) -> i2c_msg:
    return i2c_msg.write(mux, [mask])


def convert() -> i2c_msg:
    return i2c_msg.write(TILE, [0x12, 0x00])


def point(register: int = 0) -> i2c_msg:
    return i2c_msg.write(TILE, [register])


def read(count: int = 4) -> i2c_msg:
    return i2c_msg.read(TILE, count)


class Reader:
    """A program that knows smbus2 and the data sheets only."""

    def __init__(
        self, muxes: dict[int, dict[int, EmulatedMpl115a2]], scl_hz: float = 400_000
    ) -> None:
        self.clock = VirtualClock(5_000_000_000)
        devices = [EmulatedTca9548a(address, tiles.items()) for address, tiles in muxes.items()]
        self.adapter = EmulatedI2cAdapter(devices, self.clock, scl_hz)

    def send(self, *messages: i2c_msg) -> bytes:
        """Send one transaction; return the bytes of its last message."""
        self.adapter.i2c_rdwr(*messages)
        return bytes(messages[-1])

    def convert_and_wait(self) -> None:
        self.send(convert())
        self.clock.sleep_until_ns(self.clock.now_ns() + TC_NS)

    def words(self) -> Words:
        raw = self.send(point(0x04), read(8))
        a0, b1, b2, c12 = (raw[i] << 8 | raw[i + 1] for i in range(0, 8, 2))
        return a0, b1, b2, c12

    def counts(self) -> tuple[int, int]:
        raw = self.send(point(), read())
        return (raw[0] << 8 | raw[1]) >> 6, (raw[2] << 8 | raw[3]) >> 6


def alone(tile: EmulatedMpl115a2, scl_hz: float = 400_000) -> Reader:
    """Return a reader of one tile on channel 0, selected."""
    reader = Reader({MUX: {0: tile}}, scl_hz)
    reader.send(select(0b1))
    return reader


def get_errno(transact: Callable[[], object]) -> int | None:
    with pytest.raises(OSError) as caught:  # noqa: PT011  # the test compares the number
        transact()
    assert type(caught.value) is OSError, "as of the kernel"
    return caught.value.errno


# Adapter


@pytest.mark.parametrize(
    ("make_messages", "number"),
    [
        (lambda: [point(), read(), point(), read()], errno.EOPNOTSUPP),
        (lambda: [point(), read(), convert()], errno.EOPNOTSUPP),
        (lambda: [read(), point()], errno.EOPNOTSUPP),
        (lambda: [read(), read()], errno.EOPNOTSUPP),
        (lambda: [point() for _ in range(43)], errno.EINVAL),
        (list, errno.EINVAL),
        (lambda: [read(8193)], errno.EINVAL),
    ],
    ids=["W R W R", "W R W", "R W", "R R", "43 messages", "no message", "8193 bytes"],
)
def test_an_unsupported_transaction_is_refused_before_it_reaches_the_bus(
    make_messages: Callable[[], list[i2c_msg]], number: int
) -> None:
    reader = alone(part())
    before_ns = reader.clock.now_ns()
    assert get_errno(lambda: reader.send(*make_messages())) == number
    assert reader.clock.now_ns() == before_ns


def test_the_longest_supported_transactions_are_sent() -> None:
    reader = alone(part())
    reader.send(*(point() for _ in range(42)))
    reader.send(read(8192))
    assert reader.send(convert(), point(), read()) == bytes(4)
    reader.clock.sleep_until_ns(reader.clock.now_ns() + TC_NS)
    assert reader.counts() == (410, 507)


@pytest.mark.parametrize("address", [0x00, 0x5F, 0x61, 0x6F, 0x72, 0x78])
def test_no_device_answers_at_another_address(address: int) -> None:
    reader = alone(part())
    for message in (i2c_msg.write(address, [0x12, 0]), i2c_msg.read(address, 1)):
        assert get_errno(partial(reader.send, message)) == errno.EREMOTEIO
    reader.clock.sleep_until_ns(reader.clock.now_ns() + TC_NS)
    assert reader.counts() == (0, 0)
    # The messages before a missing acknowledge take effect.
    assert get_errno(lambda: reader.send(convert(), i2c_msg.write(address, [0]))) == 121
    reader.clock.sleep_until_ns(reader.clock.now_ns() + TC_NS)
    assert reader.counts() == (410, 507)


@pytest.mark.parametrize(("scl_hz", "ns_per_period"), [(400_000, 2_500), (250_000, 4_000)])
@pytest.mark.parametrize(
    ("make_messages", "periods"),
    [
        (lambda: [select(1)], 20),
        (lambda: [i2c_msg.read(MUX, 1)], 20),
        (lambda: [convert()], 29),
        (lambda: [point(), read(2)], 48),
        (lambda: [point(), read()], 66),
        (lambda: [point(4), read(8)], 102),
        (lambda: [convert(), point(), read()], 94),
        (lambda: [i2c_msg.write(0x61, [0])], 11),
    ],
    ids=[
        *("mux select", "mux read-back", "convert", "read pressure", "read both"),
        *("read coefficients", "restart and read", "no acknowledge"),
    ],
)
def test_a_transaction_takes_its_scl_periods_to_the_nanosecond(
    make_messages: Callable[[], list[i2c_msg]], periods: int, scl_hz: float, ns_per_period: int
) -> None:
    reader = alone(part(), scl_hz)
    before_ns = reader.clock.now_ns()
    if periods == 11:
        assert get_errno(lambda: reader.send(*make_messages())) == errno.EREMOTEIO
    else:
        reader.send(*make_messages())
    assert reader.clock.now_ns() - before_ns == periods * ns_per_period


def test_a_message_object_can_be_used_again() -> None:
    samples = iter([(410, 507), (272, 521)])
    reader = alone(EmulatedMpl115a2(Mpl115a2Part(DATA_SHEET_CHIP, TC_NS, lambda _: next(samples))))
    pointer, answer = point(), read(2)
    seen = []
    for _ in range(2):
        reader.convert_and_wait()
        seen.append(reader.send(pointer, answer))
    assert seen == [bytes.fromhex("6680"), bytes.fromhex("4400")]


# Muxes


def test_at_power_up_no_tile_is_connected() -> None:
    reader = Reader({MUX: {0: part()}})
    assert get_errno(reader.words) == 121
    assert reader.send(i2c_msg.read(MUX, 1)) == b"\0"


def test_a_select_takes_effect_at_the_stop_only() -> None:
    reader = Reader({MUX: {0: part((410, 507)), 1: part((272, 521), FORUM_CHIP)}})
    assert get_errno(lambda: reader.send(select(0b01), point(4), read(8))) == 121
    assert reader.words() == DATA_SHEET_CHIP, "the STOP of a failed transaction counts, too"
    # Joined by repeated STARTs the access goes to the old channel.
    answer = reader.send(select(0b10), point(4), read(8))
    assert answer.hex() == "3eceb3f9c51733c8"
    assert reader.words() == FORUM_CHIP
    reader.send(select(0b01), select(0b10))
    reader.send(i2c_msg.write(MUX, []))  # no byte, no mask
    assert reader.words() == FORUM_CHIP
    reader.send(select(0b01))
    reader.send(select(0b10), convert())
    reader.clock.sleep_until_ns(reader.clock.now_ns() + 2 * TC_NS)
    assert reader.counts() == (0, 0), "the new tile has not converted"
    reader.send(select(0b01))
    assert reader.counts() == (410, 507)


# Open drain


@settings(max_examples=50)
@given(
    tiles=st.dictionaries(
        st.tuples(st.sampled_from([MUX, OTHER_MUX]), st.integers(0, 7)),
        st.tuples(*[st.integers(0, 0xFFFF)] * 4),
        max_size=8,
    ),
    masks=st.tuples(st.integers(0, 255), st.integers(0, 255)),
)
def test_a_read_is_the_bitwise_and_of_the_tiles_on_all_open_channels(
    tiles: dict[tuple[int, int], Words], masks: tuple[int, int]
) -> None:
    open_masks = dict(zip((MUX, OTHER_MUX), masks, strict=True))
    reader = Reader(
        {
            mux: {c: part(words=words) for (m, c), words in tiles.items() if m == mux}
            for mux in open_masks
        }
    )
    for mux, mask in open_masks.items():
        reader.send(select(mask, mux))
    words = [words for (mux, channel), words in tiles.items() if open_masks[mux] >> channel & 1]
    if words:
        assert reader.words() == tuple(reduce(and_, column) for column in zip(*words, strict=True))
    else:
        assert get_errno(reader.words) == 121


def test_a_broadcast_reaches_all_open_tiles_and_needs_one_acknowledge() -> None:
    silent = part()
    silent.on_address = lambda reading, t_ns: False  # type: ignore[method-assign]  # of this part only
    reader = Reader(
        {MUX: {0: part((410, 507)), 1: part((272, 521)), 2: silent}, OTHER_MUX: {0: part((1, 2))}}
    )
    reader.send(select(0b111))
    reader.send(select(0b1, OTHER_MUX))
    reader.convert_and_wait()
    seen = []
    for mask, other_mask in ((1, 0), (2, 0), (0, 1)):
        reader.send(select(mask))
        reader.send(select(other_mask, OTHER_MUX))
        seen.append(reader.counts())
    assert seen == [(410, 507), (272, 521), (1, 2)]
    reader.send(select(0, OTHER_MUX))
    reader.send(select(0b100))
    assert get_errno(lambda: reader.send(convert())) == 121


class Port:
    """A device that records its calls and acknowledges by a script."""

    def __init__(self, address: int, acknowledges: Iterable[bool] = ()) -> None:
        self.address = address
        self.connected_mask = 0
        self.received: list[int | str] = []
        self._acknowledges = iter(acknowledges)

    def on_address(self, reading: bool, t_ns: int) -> bool:
        self.received.append("read" if reading else "write")
        return True

    def receive_byte(self, value: int) -> bool:
        self.received.append(value)
        return next(self._acknowledges, True)

    def send_bytes(self, count: int) -> bytes:
        return b"\xff" * count

    def on_stop(self, t_ns: int) -> None:
        self.received.append("stop")

    def interrupt_supply(self) -> None:
        pass

    def get_connected_devices(self) -> Iterable[Port]:
        return ()

    def apply_faults(self, t_ns: int) -> None:
        pass

    def reset(self) -> None:
        self.received.append("reset")


def test_a_data_byte_without_acknowledge_ends_the_transaction() -> None:
    clock = VirtualClock()
    port = Port(0x20, acknowledges=[True, False])
    adapter = EmulatedI2cAdapter([port], clock, 400_000)
    assert get_errno(lambda: adapter.i2c_rdwr(i2c_msg.write(0x20, [1, 2, 3]))) == errno.EREMOTEIO
    assert port.received == ["write", 1, 2, "stop"]
    assert clock.now_ns() == (10 + 9 + 9 + 1) * 2_500


def test_a_data_byte_needs_the_acknowledge_of_one_device() -> None:
    ports = [Port(0x20, [False, True]), Port(0x20, [True, False])]
    adapter = EmulatedI2cAdapter(ports, VirtualClock(), 400_000)
    adapter.i2c_rdwr(i2c_msg.write(0x20, [1, 2]))
    assert [port.received for port in ports] == [["write", 1, 2, "stop"]] * 2


# One emulated TCA9548A


def write(mux: EmulatedTca9548a, *values: int) -> None:
    assert mux.on_address(False, 0)
    assert all(mux.receive_byte(value) for value in values)


@given(before=st.integers(0, 255), after=st.binary(max_size=5), count=st.integers(0, 4))
def test_the_last_byte_written_is_the_mask_from_the_stop_on(
    before: int, after: bytes, count: int
) -> None:
    tiles = {channel: part() for channel in range(7)}  # none on channel 7
    mux = EmulatedTca9548a(0x70, tiles.items())

    def connected(mask: int) -> list[EmulatedMpl115a2]:
        return [t for c, t in tiles.items() if mask >> c & 1]

    write(mux, before)
    mux.on_stop(0)
    # The part has no register numbers: SMBus write_byte_data leaves its last byte.
    write(mux, *after)
    assert mux.connected_mask == before
    assert list(mux.get_connected_devices()) == connected(before)
    mux.on_stop(0)
    mask = after[-1] if after else before
    for _ in range(2):  # a read and its STOP change nothing
        assert mux.connected_mask == mask
        assert list(mux.get_connected_devices()) == connected(mask)
        mux.on_address(True, 0)
        assert mux.send_bytes(count) == bytes([mask]) * count
        mux.on_stop(0)


# Faults


def open_mux(**faults: tuple[int, int]) -> EmulatedTca9548a:
    """Return a mux with channel 0 open and each fault in one interval of nanoseconds."""
    timings = {
        name: FaultTiming([(begin_ns * 1e-9, end_ns * 1e-9)])
        for name, (begin_ns, end_ns) in faults.items()
    }
    for timing in timings.values():
        timing.begin_scene_time(0)
    mux = EmulatedTca9548a(0x70, [(0, part())], timings.get("brown_out"), timings.get("mux_reset"))
    write(mux, 1)
    mux.on_stop(0)
    return mux


def test_a_mux_without_supply_is_silent_and_connects_nothing_afterwards() -> None:
    mux = open_mux(brown_out=(100, 200))
    mux.apply_faults(99)
    assert mux.on_address(False, 99)
    assert mux.connected_mask == 1
    mux.apply_faults(100)
    assert not mux.on_address(False, 100)
    assert not mux.on_address(True, 199)
    assert mux.connected_mask == 0
    mux.apply_faults(200)
    assert mux.on_address(True, 200)
    assert (mux.connected_mask, mux.send_bytes(1)) == (0, b"\0")


def test_a_brown_out_between_two_transfers_closes_all_channels() -> None:
    mux = open_mux(brown_out=(100, 200))
    mux.apply_faults(50)
    mux.apply_faults(300)
    assert mux.on_address(True, 300)
    assert (mux.connected_mask, mux.send_bytes(1)) == (0, b"\0")


def test_a_mux_can_be_opened_at_once_after_its_reset() -> None:
    mux = open_mux(mux_reset=(100, 200))
    mux.apply_faults(50)
    mux.apply_faults(150)
    assert mux.on_address(False, 150)
    assert mux.connected_mask == 0
    assert mux.receive_byte(1)
    mux.on_stop(150)
    mux.apply_faults(160)
    assert mux.connected_mask == 1, "it is reset once"


def test_the_reset_line_clears_a_mask_that_is_not_yet_in_force() -> None:
    mux = EmulatedTca9548a(0x70, [(0, part())])
    write(mux, 1)
    mux.reset()
    mux.on_stop(0)
    assert mux.connected_mask == 0
