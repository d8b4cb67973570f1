"""The multiplexers: the exact bytes, and that never more is open than was asked for."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from smbus2 import i2c_msg

from devices.buses.i2c import I2cBus
from devices.chips.tca9548a import ADDRESSES, CHANNELS, MuxRouter, Tca9548a
from devices.clock import VirtualClock
from devices.emulation.chips.tca9548a import EmulatedTca9548a
from devices.emulation.i2c_bus import EmulatedI2cAdapter
from devices.errors import BusFaultError, BusMisuseError, I2cError, NoAcknowledgeError
from tests.devices.adapters import Adapter

NACK, TIMEOUT, REFUSED = 121, 110, 22


class Protocol(Adapter):
    """An adapter that expects these transactions, one message each, and no other.

    "70<01" is the byte 0x01 written to 0x70, "70>01" the byte 0x01 read from it; a number behind it
    is the errno it fails with.
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
        """In this block exactly these transactions take place."""
        assert not self.left
        self.left = list(steps)
        yield
        assert not self.left, "these were expected and did not come"

    def connects(self, muxes: MuxRouter, address: int, channel: int, *steps: str) -> None:
        """To connect one channel takes exactly these transactions."""
        with self.exchanged(*steps):
            muxes.connect_single_channel(address, channel)


@pytest.fixture
def protocol() -> Protocol:
    return Protocol()


def router(protocol: Protocol, *addresses: int) -> MuxRouter:
    return MuxRouter(I2cBus(protocol, "script"), addresses or (0x70, 0x71))


# One multiplexer


def test_there_are_eight_muxes_of_eight_channels() -> None:
    assert list(ADDRESSES) == [0x70, 0x71, 0x72, 0x73, 0x74, 0x75, 0x76, 0x77]
    assert list(CHANNELS) == list(range(8))


def test_a_mask_is_one_byte_without_a_register_number(protocol: Protocol) -> None:
    mux = Tca9548a(I2cBus(protocol, "script"), 0x74)
    with protocol.exchanged("74<00", "74<81", "74<ff"):
        mux.write_mask(0)
        mux.write_mask(0x81)
        mux.write_mask(0xFF)


def test_the_mask_is_read_back_as_one_byte(protocol: Protocol) -> None:
    mux = Tca9548a(I2cBus(protocol, "script"), 0x77)
    with protocol.exchanged("77>a5", "77>00"):
        assert mux.read_mask() == 0xA5
        assert mux.read_mask() == 0x00


@pytest.mark.parametrize("mask", [-257, 256])
def test_a_mask_of_more_than_eight_bits_is_no_mask(protocol: Protocol, mask: int) -> None:
    with pytest.raises(IndexError):
        Tca9548a(I2cBus(protocol, "script"), 0x70).write_mask(mask)


# All multiplexers


def test_the_first_selection_closes_every_other_mux_first(protocol: Protocol) -> None:
    # Nothing is known of them: whoever used the bus before may have left them open.
    muxes = router(protocol, 0x70, 0x71, 0x72)
    protocol.connects(muxes, 0x71, 3, "70<00", "72<00", "71<08")


def test_what_is_open_is_not_written_again(protocol: Protocol) -> None:
    muxes = router(protocol)
    protocol.connects(muxes, 0x70, 0, "71<00", "70<01")
    protocol.connects(muxes, 0x70, 0)
    protocol.connects(muxes, 0x70, 1, "70<02")


def test_the_mux_that_is_left_is_closed_before_another_one_opens(protocol: Protocol) -> None:
    muxes = router(protocol)
    protocol.connects(muxes, 0x70, 7, "71<00", "70<80")
    protocol.connects(muxes, 0x71, 0, "70<00", "71<01")
    protocol.connects(muxes, 0x70, 7, "71<00", "70<80")


def test_a_broadcast_opens_all_that_is_asked_for_and_is_closed_again(protocol: Protocol) -> None:
    muxes = router(protocol, 0x70, 0x71, 0x72)
    with protocol.exchanged("72<00", "70<0f", "71<f0"):
        muxes.connect_channels({0x70: 0x0F, 0x71: 0xF0})
    with protocol.exchanged():
        muxes.connect_channels({0x70: 0x0F, 0x71: 0xF0})
    protocol.connects(muxes, 0x70, 0, "71<00", "70<01")


def test_a_mask_of_zero_closes_a_mux_once(protocol: Protocol) -> None:
    muxes = router(protocol)
    with protocol.exchanged("70<00", "71<00"):
        muxes.connect_channels({})
    with protocol.exchanged("70<01"):
        muxes.connect_channels({0x70: 1, 0x71: 0})
    with protocol.exchanged("70<00"):
        muxes.connect_channels({0x70: 0, 0x71: 0})


def test_a_forgotten_routing_is_written_afresh(protocol: Protocol) -> None:
    muxes = router(protocol)
    protocol.connects(muxes, 0x70, 0, "71<00", "70<01")
    muxes.invalidate_cache()
    protocol.connects(muxes, 0x70, 0, "71<00", "70<01")


@pytest.mark.parametrize(
    ("number", "kind"),
    [(NACK, NoAcknowledgeError), (TIMEOUT, BusFaultError), (REFUSED, BusMisuseError)],
)
def test_what_a_mux_connects_after_a_failed_write_is_not_taken_as_known(
    protocol: Protocol, number: int, kind: type[I2cError]
) -> None:
    muxes = router(protocol, 0x70, 0x71, 0x72)
    protocol.connects(muxes, 0x70, 0, "71<00", "72<00", "70<01")
    with protocol.exchanged(f"70<02 {number}"), pytest.raises(kind):
        muxes.connect_single_channel(0x70, 1)
    # It may have heard it or not; the others were not spoken to.
    protocol.connects(muxes, 0x70, 0, "70<01")
    muxes.invalidate_cache()  # what a user of the bus does after a fault of the bus itself
    protocol.connects(muxes, 0x70, 0, "71<00", "72<00", "70<01")


def test_one_mux_alone_can_be_forgotten(protocol: Protocol) -> None:
    muxes = router(protocol, 0x70, 0x71, 0x72)
    protocol.connects(muxes, 0x70, 0, "71<00", "72<00", "70<01")
    muxes.invalidate_cache(0x72)
    protocol.connects(muxes, 0x70, 0, "72<00")


def test_a_mux_that_does_not_close_keeps_the_others_shut(protocol: Protocol) -> None:
    muxes = router(protocol)
    protocol.connects(muxes, 0x70, 0, "71<00", "70<01")
    with protocol.exchanged(f"70<00 {NACK}"), pytest.raises(NoAcknowledgeError):
        muxes.connect_single_channel(0x71, 0)
    protocol.connects(muxes, 0x71, 0, "70<00", "71<01")


def test_a_mux_that_refuses_to_be_closed_twice_in_a_row_is_silent_and_in_nobodys_way(
    protocol: Protocol,
) -> None:
    muxes = router(protocol)
    protocol.connects(muxes, 0x70, 0, "71<00", "70<01")
    with protocol.exchanged(f"70<00 {NACK}"), pytest.raises(NoAcknowledgeError):
        muxes.connect_single_channel(0x71, 0)
    assert muxes.silent_addresses == set()
    protocol.connects(muxes, 0x71, 0, f"70<00 {NACK}", "71<01")
    assert muxes.silent_addresses == {0x70}
    with protocol.exchanged("71<02"):  # nor is it asked any more
        muxes.connect_single_channel(0x71, 1)
    protocol.connects(muxes, 0x70, 2, "71<00", "70<04")
    assert muxes.silent_addresses == set(), "it has answered"


def test_a_mux_that_fails_with_the_bus_is_not_silent(protocol: Protocol) -> None:
    muxes = router(protocol)
    protocol.connects(muxes, 0x70, 0, "71<00", "70<01")
    for _ in range(3):
        with protocol.exchanged(f"70<00 {TIMEOUT}"), pytest.raises(BusFaultError):
            muxes.connect_single_channel(0x71, 0)
    assert muxes.silent_addresses == set()


# Are they what they should be?


def test_an_audit_reads_back_every_mux_of_which_something_is_known(protocol: Protocol) -> None:
    muxes = router(protocol, 0x70, 0x71, 0x72)
    protocol.connects(muxes, 0x70, 2, "71<00", "72<00", "70<04")
    with protocol.exchanged("70>04", "71>00", "72>00"):
        assert muxes.verify_masks()
    muxes.invalidate_cache(0x71)
    with protocol.exchanged("70>04", "72>00"):
        assert muxes.verify_masks()


@pytest.mark.parametrize(
    ("read", "mended"),
    [(("70>00", "71>00"), "70<04"), (("70>04", "71>01"), "71<00")],
    ids=["reset", "opened"],
)
def test_a_mux_that_was_reset_or_opened_behind_our_back_is_found_by_an_audit(
    protocol: Protocol, read: tuple[str, str], mended: str
) -> None:
    muxes = router(protocol)
    protocol.connects(muxes, 0x70, 2, "71<00", "70<04")
    with protocol.exchanged(*read):
        assert not muxes.verify_masks()
    protocol.connects(muxes, 0x70, 2, mended)


def test_a_mux_that_does_not_answer_an_audit_is_not_taken_as_known(protocol: Protocol) -> None:
    muxes = router(protocol)
    protocol.connects(muxes, 0x70, 2, "71<00", "70<04")
    with protocol.exchanged(f"70>04 {NACK}", "71>00"):
        assert not muxes.verify_masks()
    protocol.connects(muxes, 0x70, 2, "70<04")
    with protocol.exchanged(f"70>04 {TIMEOUT}"), pytest.raises(BusFaultError):
        muxes.verify_masks()


def test_one_mux_that_keeps_what_is_written_proves_that_the_wires_move(protocol: Protocol) -> None:
    muxes = router(protocol, 0x70, 0x71, 0x72)
    with protocol.exchanged(f"70<01 {NACK}", "71<01", "71>01"):
        assert muxes.check_any_mux_works()
    # It was only a trial: nothing is taken as known afterwards.
    protocol.connects(muxes, 0x70, 0, "71<00", "72<00", "70<01")


def test_a_bus_on_which_everything_reads_as_zero_does_not_move(protocol: Protocol) -> None:
    muxes = router(protocol)
    with protocol.exchanged("70<01", "70>00", "71<01", "71>00"):
        assert not muxes.check_any_mux_works()


def test_a_bus_on_which_nobody_answers_does_not_move(protocol: Protocol) -> None:
    muxes = router(protocol)
    with protocol.exchanged(f"70<01 {NACK}", f"71<01 {NACK}"):
        assert not muxes.check_any_mux_works()
    with protocol.exchanged(f"70<01 {TIMEOUT}"), pytest.raises(BusFaultError):
        muxes.check_any_mux_works()


class Watch(Adapter):
    """Emulated muxes beneath an adapter that fails when told, and looks at them at every STOP."""

    def __init__(self, addresses: list[int], outcomes: list[str]) -> None:
        self.muxes = [EmulatedTca9548a(address, {}) for address in addresses]
        self.adapter = EmulatedI2cAdapter(self.muxes, VirtualClock(), 400_000)
        self.outcomes = iter(outcomes)
        self.most_open = 0

    def i2c_rdwr(self, *i2c_msgs: i2c_msg) -> None:
        outcome = next(self.outcomes, "done")
        if outcome == "lost":
            raise OSError(NACK, "the mux never heard it")
        self.adapter.i2c_rdwr(*i2c_msgs)
        self.most_open = max(self.most_open, sum(mux.connected_mask != 0 for mux in self.muxes))
        if outcome == "late":
            raise OSError(TIMEOUT, "the mux heard it, but we were not told")

    def routing(self) -> dict[int, int]:
        return {mux.address: mux.connected_mask for mux in self.muxes if mux.connected_mask}


three = st.sampled_from([0x70, 0x71, 0x76])
outcomes = st.lists(st.sampled_from(["done", "done", "lost", "late"]), max_size=30)


@settings(max_examples=50)
@given(selects=st.lists(st.tuples(three, st.integers(0, 7)), max_size=12), outcomes=outcomes)
def test_never_is_more_than_one_mux_open_whatever_fails(
    selects: list[tuple[int, int]], outcomes: list[str]
) -> None:
    watch = Watch([0x70, 0x71, 0x76], outcomes)
    muxes = MuxRouter(I2cBus(watch, "watched"), [0x70, 0x71, 0x76])
    for address, channel in selects:
        try:
            muxes.connect_single_channel(address, channel)
        except I2cError:
            if muxes.silent_addresses:
                return
            continue
        connected = watch.routing()
        # One that refused twice in a row is taken to be without supply.
        assert {a: m for a, m in connected.items() if a not in muxes.silent_addresses} == {
            address: 1 << channel
        }
        if muxes.silent_addresses:
            return
    assert watch.most_open <= 1


masks = st.dictionaries(three, st.integers(0, 255))


@settings(max_examples=50)
@given(wanted=st.lists(masks, max_size=12), outcomes=outcomes)
def test_after_a_success_exactly_what_was_asked_for_is_connected(
    wanted: list[dict[int, int]], outcomes: list[str]
) -> None:
    watch = Watch([0x70, 0x71, 0x76], outcomes)
    muxes = MuxRouter(I2cBus(watch, "watched"), [0x70, 0x71, 0x76])
    for routing in wanted:
        try:
            muxes.connect_channels(routing)
        except I2cError:
            continue
        if muxes.silent_addresses:
            return
        assert watch.routing() == {address: mask for address, mask in routing.items() if mask}
