"""The multiplexers: their bytes, and the channels that are open."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from smbus2 import i2c_msg

from devices.buses.i2c import I2cBus
from devices.chips.tca9548a import MuxRouter, Tca9548a
from devices.clock import VirtualClock
from devices.emulation.chips.tca9548a import EmulatedTca9548a
from devices.emulation.i2c_bus import EmulatedI2cAdapter
from devices.errors import BusFaultError, BusMisuseError, I2cError, NoAcknowledgeError
from tests.devices.rigs import Adapter

NACK, TIMEOUT, REFUSED = 121, 110, 22


class Protocol(Adapter):
    """An adapter that expects these transactions, one message each, and no other.

    "70<01" is the byte 0x01 written to 0x70, "70>01" the byte 0x01 read from it; a number after it
    is the errno of its failure.
    """

    def __init__(self) -> None:
        self.left: list[str] = []

    def i2c_rdwr(self, *i2c_msgs: i2c_msg) -> None:
        assert len(i2c_msgs) == 1, "a select shares its transaction with nothing"
        assert self.left, f"unexpected: {i2c_msgs[0]!r}"
        step, _, number = self.left.pop(0).partition(" ")
        (message,) = i2c_msgs
        if message.flags & 1:
            assert step[:3] == f"{message.addr:02x}>"
            assert message.len == 1
            message.buf[0] = int(step[3:], 16)
        else:
            assert step == f"{message.addr:02x}<{bytes(message).hex()}"
        if number:
            raise OSError(int(number), "scripted")

    @contextmanager
    def exchanged(self, *steps: str) -> Iterator[None]:
        """Expect exactly these transactions in a block."""
        assert not self.left
        self.left = list(steps)
        yield
        assert not self.left

    def connects(self, muxes: MuxRouter, address: int, channel: int, *steps: str) -> None:
        """Connect one channel by exactly these transactions."""
        with self.exchanged(*steps):
            muxes.connect_single_channel(address, channel)


@pytest.fixture
def protocol() -> Protocol:
    return Protocol()


def router(protocol: Protocol, *addresses: int) -> MuxRouter:
    return MuxRouter(I2cBus(protocol, "script"), addresses or (0x70, 0x71))


# One multiplexer


def test_a_mask_is_written_and_read_as_one_byte_without_a_register_number(
    protocol: Protocol,
) -> None:
    mux = Tca9548a(I2cBus(protocol, "script"), 0x74)
    with protocol.exchanged("74<00", "74<81", "74<ff", "74>a5", "74>00"):
        for mask in (0, 0x81, 0xFF):
            mux.write_mask(mask)
        assert [mux.read_mask(), mux.read_mask()] == [0xA5, 0x00]


@pytest.mark.parametrize("mask", [-257, 256])
def test_a_mask_of_more_than_eight_bits_is_no_mask(protocol: Protocol, mask: int) -> None:
    with pytest.raises(IndexError):
        Tca9548a(I2cBus(protocol, "script"), 0x70).write_mask(mask)


# All multiplexers


def test_a_selection_writes_the_muxes_that_change_and_closes_before_it_opens(
    protocol: Protocol,
) -> None:
    muxes = router(protocol, 0x70, 0x71, 0x72)
    # At first nothing is known: another program may have left any mux open.
    protocol.connects(muxes, 0x71, 3, "70<00", "72<00", "71<08")
    protocol.connects(muxes, 0x71, 3)
    protocol.connects(muxes, 0x71, 4, "71<10")
    protocol.connects(muxes, 0x70, 7, "71<00", "70<80")
    protocol.connects(muxes, 0x71, 0, "70<00", "71<01")
    muxes.invalidate_cache()
    protocol.connects(muxes, 0x71, 0, "70<00", "72<00", "71<01")
    muxes.invalidate_cache(0x72)
    protocol.connects(muxes, 0x71, 0, "72<00")


def test_a_broadcast_opens_exactly_its_channels(protocol: Protocol) -> None:
    muxes = router(protocol, 0x70, 0x71, 0x72)
    with protocol.exchanged("72<00", "70<0f", "71<f0"):
        muxes.connect_channels({0x70: 0x0F, 0x71: 0xF0})
    with protocol.exchanged():
        muxes.connect_channels({0x70: 0x0F, 0x71: 0xF0})
    protocol.connects(muxes, 0x70, 0, "71<00", "70<01")
    with protocol.exchanged():
        muxes.connect_channels({0x70: 1, 0x71: 0})
    with protocol.exchanged("70<00"):
        muxes.connect_channels({0x70: 0, 0x71: 0})
    with protocol.exchanged():
        muxes.connect_channels({})


@pytest.mark.parametrize(
    ("number", "kind"),
    [(NACK, NoAcknowledgeError), (TIMEOUT, BusFaultError), (REFUSED, BusMisuseError)],
)
def test_a_mux_is_written_again_after_a_failed_write(
    protocol: Protocol, number: int, kind: type[I2cError]
) -> None:
    muxes = router(protocol, 0x70, 0x71, 0x72)
    protocol.connects(muxes, 0x70, 0, "71<00", "72<00", "70<01")
    with protocol.exchanged(f"70<02 {number}"), pytest.raises(kind):
        muxes.connect_single_channel(0x70, 1)
    # It may have received the mask or not; the others were not written.
    protocol.connects(muxes, 0x70, 0, "70<01")


def test_a_mux_that_does_not_close_keeps_the_others_closed_until_it_fails_a_second_time(
    protocol: Protocol,
) -> None:
    muxes = router(protocol)
    protocol.connects(muxes, 0x70, 0, "71<00", "70<01")
    with protocol.exchanged(f"70<00 {NACK}"), pytest.raises(NoAcknowledgeError):
        muxes.connect_single_channel(0x71, 0)
    assert muxes.silent_addresses == set()
    protocol.connects(muxes, 0x71, 0, f"70<00 {NACK}", "71<01")
    assert muxes.silent_addresses == {0x70}
    protocol.connects(muxes, 0x71, 1, "71<02")  # the silent one is not closed any more
    protocol.connects(muxes, 0x70, 2, "71<00", "70<04")
    assert muxes.silent_addresses == set(), "it has answered"


def test_a_mux_that_fails_with_the_bus_is_not_silent(protocol: Protocol) -> None:
    muxes = router(protocol)
    protocol.connects(muxes, 0x70, 0, "71<00", "70<01")
    for _ in range(3):
        with protocol.exchanged(f"70<00 {TIMEOUT}"), pytest.raises(BusFaultError):
            muxes.connect_single_channel(0x71, 0)
    assert muxes.silent_addresses == set()


# Audit and trial


def test_an_audit_reads_back_every_mux_of_known_mask(protocol: Protocol) -> None:
    muxes = router(protocol, 0x70, 0x71, 0x72)
    protocol.connects(muxes, 0x70, 2, "71<00", "72<00", "70<04")
    with protocol.exchanged("70>04", "71>00", "72>00"):
        assert muxes.verify_masks()
    muxes.invalidate_cache(0x71)
    with protocol.exchanged("70>04", "72>00"):
        assert muxes.verify_masks()
    with protocol.exchanged(f"70>04 {TIMEOUT}"), pytest.raises(BusFaultError):
        muxes.verify_masks()


@pytest.mark.parametrize(
    ("read", "repaired"),
    [
        (("70>00", "71>00"), "70<04"),
        (("70>04", "71>01"), "71<00"),
        ((f"70>04 {NACK}", "71>00"), "70<04"),
    ],
    ids=["reset", "opened", "silent"],
)
def test_a_mux_that_fails_an_audit_is_written_again(
    protocol: Protocol, read: tuple[str, str], repaired: str
) -> None:
    muxes = router(protocol)
    protocol.connects(muxes, 0x70, 2, "71<00", "70<04")
    with protocol.exchanged(*read):
        assert not muxes.verify_masks()
    protocol.connects(muxes, 0x70, 2, repaired)


@pytest.mark.parametrize(
    ("steps", "works"),
    [
        ((f"70<01 {NACK}", "71<01", "71>01"), True),
        (("70<01", "70>00", "71<01", "71>00"), False),
        ((f"70<01 {NACK}", f"71<01 {NACK}"), False),
    ],
    ids=["one mux keeps its mask", "every bit reads as zero", "no mux answers"],
)
def test_a_bus_works_if_one_mux_keeps_its_mask(
    protocol: Protocol, steps: tuple[str, ...], works: bool
) -> None:
    muxes = router(protocol)
    with protocol.exchanged(*steps):
        assert muxes.check_any_mux_works() == works
    # After the trial no mask is known.
    protocol.connects(muxes, 0x70, 0, "71<00", "70<01")


def test_a_trial_of_a_stuck_bus_is_a_fault_of_the_bus(protocol: Protocol) -> None:
    with protocol.exchanged(f"70<01 {TIMEOUT}"), pytest.raises(BusFaultError):
        router(protocol).check_any_mux_works()


class Watch(Adapter):
    """Emulated muxes behind an adapter that fails as scripted, and inspects them at every STOP."""

    def __init__(self, outcomes: list[str]) -> None:
        self.muxes = [EmulatedTca9548a(address, {}) for address in (0x70, 0x71, 0x76)]
        self.adapter = EmulatedI2cAdapter(self.muxes, VirtualClock(), 400_000)
        self.outcomes = iter(outcomes)
        self.most_open = 0
        self.router = MuxRouter(I2cBus(self, "watched"), [0x70, 0x71, 0x76])

    def i2c_rdwr(self, *i2c_msgs: i2c_msg) -> None:
        outcome = next(self.outcomes, "done")
        if outcome == "lost":
            raise OSError(NACK, "the mux received nothing")
        self.adapter.i2c_rdwr(*i2c_msgs)
        self.most_open = max(self.most_open, sum(mux.connected_mask != 0 for mux in self.muxes))
        if outcome == "late":
            raise OSError(TIMEOUT, "the mux received it, but the caller gets an error")

    def routing(self) -> dict[int, int]:
        return {mux.address: mux.connected_mask for mux in self.muxes if mux.connected_mask}


addresses = st.sampled_from([0x70, 0x71, 0x76])
outcomes = st.lists(st.sampled_from(["done", "done", "lost", "late"]), max_size=30)


@settings(max_examples=50)
@given(selects=st.lists(st.tuples(addresses, st.integers(0, 7)), max_size=12), outcomes=outcomes)
def test_no_two_muxes_are_open_at_once_whatever_fails(
    selects: list[tuple[int, int]], outcomes: list[str]
) -> None:
    watch = Watch(outcomes)
    for address, channel in selects:
        with suppress(I2cError):
            watch.router.connect_single_channel(address, channel)
            # A mux that failed twice in a row is assumed to be without supply.
            connected = watch.routing().items()
            silent = watch.router.silent_addresses
            assert {a: m for a, m in connected if a not in silent} == {address: 1 << channel}
        if watch.router.silent_addresses:
            return
    assert watch.most_open <= 1


@settings(max_examples=50)
@given(
    wanted=st.lists(st.dictionaries(addresses, st.integers(0, 255)), max_size=12),
    outcomes=outcomes,
)
def test_after_a_success_exactly_the_requested_channels_are_connected(
    wanted: list[dict[int, int]], outcomes: list[str]
) -> None:
    watch = Watch(outcomes)
    for routing in wanted:
        try:
            watch.router.connect_channels(routing)
        except I2cError:
            continue
        if watch.router.silent_addresses:
            return
        assert watch.routing() == {address: mask for address, mask in routing.items() if mask}
