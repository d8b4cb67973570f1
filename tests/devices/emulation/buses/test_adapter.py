"""What a Raspberry Pi's adapter refuses, and how long transactions take."""

from __future__ import annotations

import errno
from collections.abc import Callable
from functools import partial

import pytest
from smbus2 import i2c_msg

from devices.emulation.chips.mpl115a2 import EmulatedMpl115a2, EmulatedPart
from tests.builders.arrays import DATA_SHEET_CHIP
from tests.devices.emulation.buses.readers import (
    MUX,
    OTHER_MUX,
    TC_NS,
    TILE,
    Reader,
    alone,
    chip,
    read,
    refusal,
    write,
)


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

    reader = alone(EmulatedMpl115a2(EmulatedPart(DATA_SHEET_CHIP, TC_NS, sense)))
    begin_ns = reader.clock.now_ns()
    reader.convert()
    # 29 periods of 2.5 us to the STOP; sampled a quarter into the conversion (hardware.md 1.4)
    assert sampled_ns == [begin_ns + 72_500 + TC_NS // 4]
