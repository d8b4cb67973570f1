"""The bus: whose fault an error was, and what is done to a real adapter."""

from __future__ import annotations

import ctypes
import errno
import os
import pickle
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from smbus2 import SMBus, i2c_msg

from devices.array.tile import classify_impossible_counts
from devices.buses.i2c import I2cBus, RetryingBus, open_bus
from devices.chips.mpl115a2 import Mpl115a2
from devices.clock import VirtualClock
from devices.emulation.chips.tca9548a import EmulatedTca9548a
from devices.emulation.fault_timing import SceneFaults
from devices.emulation.i2c_bus import EmulatedI2cAdapter, FaultyWires
from devices.errors import (
    BusFaultError,
    BusLostError,
    BusMisuseError,
    BusSetupError,
    FootTileError,
    I2cError,
    NoAcknowledgeError,
    TileSetupError,
    UsageError,
)
from devices.flags import TileFlag
from tests.devices.adapters import Adapter
from tests.waiting import until


class BrokenAdapter(Adapter):
    """Every transaction fails with one errno."""

    def __init__(self, error: OSError) -> None:
        self.error = error

    def i2c_rdwr(self, *i2c_msgs: i2c_msg) -> None:
        raise self.error


def failure_of(error: OSError, *messages: i2c_msg) -> I2cError:
    bus = I2cBus(BrokenAdapter(error), "/dev/i2c-7")
    with pytest.raises(I2cError) as caught:
        bus.transfer(*messages)
    assert caught.value.__cause__ is error
    return caught.value


# hardware.md 3.3: numbers as on Linux, so that a wrong table cannot hide behind the names
TABLE = [
    (6, "ENXIO", NoAcknowledgeError),
    (121, "EREMOTEIO", NoAcknowledgeError),
    (5, "EIO", BusFaultError),
    (110, "ETIMEDOUT", BusFaultError),
    (11, "EAGAIN", BusFaultError),
    (16, "EBUSY", BusFaultError),
    (22, "EINVAL", BusMisuseError),
    (95, "EOPNOTSUPP", BusMisuseError),
    (19, "ENODEV", BusLostError),
    (2, "ENOENT", BusLostError),
    (13, "EACCES", BusLostError),
    (108, "ESHUTDOWN", BusLostError),
]


@pytest.mark.parametrize(("number", "name", "kind"), TABLE, ids=[row[1] for row in TABLE])
def test_an_errno_tells_whose_fault_it_was(number: int, name: str, kind: type[I2cError]) -> None:
    error = failure_of(OSError(number, os.strerror(number)), i2c_msg.write(0x60, [0x12, 0]))
    assert type(error) is kind
    assert error.errno == number
    assert name in str(error) or errno.errorcode[number] in str(error)


@pytest.mark.parametrize(("number", "name", "kind"), TABLE, ids=[row[1] for row in TABLE])
def test_a_failure_names_the_bus_and_the_address_and_keeps_both_through_pickling(
    number: int, name: str, kind: type[I2cError]
) -> None:
    write, read = i2c_msg.write(0x73, [0]), i2c_msg.read(0x73, 1)
    error = failure_of(OSError(number, name), write, read)
    again = pickle.loads(pickle.dumps(error))  # noqa: S301  # our own
    for one in (error, again):
        assert type(one) is kind
        assert str(one).startswith("/dev/i2c-7, address 0x73: ")
        assert one.errno == number
    assert str(again) == str(error)


def test_an_error_without_a_number_is_not_taken_for_a_missing_tile() -> None:
    error = failure_of(OSError("the adapter melted"), i2c_msg.write(0x60, [0]))
    assert type(error) is BusLostError
    assert "the adapter melted" in str(error)
    assert error.errno is None


def test_what_a_field_worker_can_do_is_said() -> None:
    message = i2c_msg.write(0x60, [0])
    assert "mux channel" in failure_of(OSError(121, ""), message).remedy
    assert "SDA and SCL" in failure_of(OSError(110, ""), message).remedy
    assert "plug" in failure_of(OSError(19, ""), message).remedy
    assert "42 messages" in failure_of(OSError(22, ""), message).expected


class Pi:
    """A machine on which smbus2 opens any bus; transactions and other ioctls are noted."""

    def __init__(self) -> None:
        self.opened: list[str] = []
        self.transactions: list[tuple[i2c_msg, ...]] = []
        self.ioctls: list[tuple[int, int, int]] = []
        self.closed = 0
        self.error: OSError | None = None
        self.done: int | None = None
        """How many messages a transaction transfers; None: all."""

    def ioctl(self, fd: int, request: int, value: Any) -> int:
        if self.error is not None:
            raise self.error
        if request != 0x0707:  # include/uapi/linux/i2c-dev.h: I2C_RDWR
            self.ioctls.append((fd, request, value))
            return 0
        messages = tuple(value.msgs[i] for i in range(value.nmsgs))
        self.transactions.append(messages)
        return len(messages) if self.done is None else self.done


@pytest.fixture
def pi(monkeypatch: pytest.MonkeyPatch) -> Pi:
    pi = Pi()

    def open_(self: SMBus, name: str) -> None:
        pi.opened.append(name)
        self.fd = 77

    def close(self: SMBus) -> None:
        pi.closed += 1

    monkeypatch.setattr(SMBus, "open", open_)
    monkeypatch.setattr(SMBus, "close", close)
    monkeypatch.setattr("devices.buses.i2c.fcntl.ioctl", pi.ioctl)
    return pi


class FakeAdapter:
    """An adapter that notes what it is asked."""

    def __init__(self) -> None:
        self.transactions: list[tuple[i2c_msg, ...]] = []
        self.timeouts: list[int] = []

    def i2c_rdwr(self, *i2c_msgs: i2c_msg) -> None:
        self.transactions.append(i2c_msgs)

    def set_timeout(self, units_10ms: int) -> None:
        self.timeouts.append(units_10ms)

    def close(self) -> None:
        pass


def test_a_real_bus_gets_a_time_out_of_30_ms_at_opening(pi: Pi) -> None:
    assert open_bus("/dev/i2c-1").name == "/dev/i2c-1"
    assert pi.opened == ["/dev/i2c-1"]
    # include/uapi/linux/i2c-dev.h: I2C_TIMEOUT, in units of 10 ms
    assert pi.ioctls == [(77, 0x0702, 3)]


def test_messages_reach_the_adapter_unchanged_and_in_one_transaction(pi: Pi) -> None:
    bus = open_bus("/dev/i2c-1")
    write, read = i2c_msg.write(0x60, [0x00]), i2c_msg.read(0x60, 4)
    bus.transfer(write, read)
    bus.transfer(write)
    wanted = [(0x60, 0, b"\x00"), (0x60, 1, b"\xff" * 4)]
    told = [[(m.addr, m.flags, bytes(m)) for m in messages] for messages in pi.transactions]
    assert told == [wanted, wanted[:1]]
    assert len(pi.ioctls) == 1, "the time-out is sticky"


@pytest.mark.parametrize("done", [0, 1])
def test_fewer_messages_than_asked_are_no_acknowledge(pi: Pi, done: int) -> None:
    bus = open_bus("/dev/i2c-1")
    pi.done = done
    with pytest.raises(NoAcknowledgeError) as caught:
        bus.transfer(i2c_msg.write(0x60, [0x00]), i2c_msg.read(0x60, 4))
    assert caught.value.errno == errno.EREMOTEIO
    assert f"{done} of 2 messages" in str(caught.value.__cause__)


@given(stale=st.binary(min_size=1, max_size=16))
def test_bytes_of_an_earlier_read_do_not_pass_as_a_reading(stale: bytes) -> None:
    read = i2c_msg.read(0x60, len(stale))
    ctypes.memmove(read.buf, stale, len(stale))
    I2cBus(FakeAdapter(), "/dev/i2c-7").transfer(read)  # fills nothing in
    assert bytes(read) == b"\xff" * len(stale)


def test_a_buffer_that_no_adapter_filled_is_never_a_plausible_reading() -> None:
    chip = Mpl115a2(I2cBus(FakeAdapter(), "/dev/i2c-7"))
    assert classify_impossible_counts(*chip.read_counts()) == TileFlag.IMPLAUSIBLE
    with pytest.raises(TileSetupError):
        chip.read_coefficient_words(where="tile A17")


def test_closing_a_bus_closes_its_adapter(pi: Pi) -> None:
    bus = open_bus("/dev/i2c-1")
    assert pi.closed == 0
    bus.close()
    assert pi.closed == 1


def test_a_world_is_not_asked_where_a_device_is_named(pi: Pi) -> None:
    world = FakeAdapter()
    open_bus("/dev/i2c-1", world).transfer(i2c_msg.write(0x70, [1]))
    assert world.transactions == []
    assert len(pi.transactions) == 1


def test_a_device_that_is_not_there_is_a_setup_error(tmp_path: Path) -> None:
    missing = str(tmp_path / "i2c-9")
    with pytest.raises(BusSetupError) as caught:
        open_bus(missing)
    assert caught.value.where == missing
    assert caught.value.errno == errno.ENOENT
    assert "i2c_arm=on" in str(caught.value)


def test_a_device_that_may_not_be_opened_is_a_setup_error(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def locked(self: SMBus, name: str) -> None:
        raise PermissionError(errno.EACCES, "Permission denied", name)

    monkeypatch.setattr(SMBus, "open", locked)
    with pytest.raises(BusSetupError, match=r"EACCES.*group i2c"):
        open_bus("/dev/i2c-1")


def test_a_file_that_is_no_bus_is_a_setup_error(tmp_path: Path) -> None:
    path = tmp_path / "notes.txt"
    path.write_text("not an adapter")
    with pytest.raises(BusSetupError, match="ENOTTY"):
        open_bus(str(path))


def test_an_emulated_bus_needs_a_world() -> None:
    with pytest.raises(UsageError, match="emulated") as caught:
        open_bus("emulated")
    assert caught.value.exit_code == 2
    assert isinstance(caught.value, FootTileError)


def test_an_emulated_bus_sits_on_the_adapter_it_is_given() -> None:
    adapter = FakeAdapter()
    message = i2c_msg.write(0x70, [1])
    bus = open_bus("emulated", adapter)
    bus.transfer(message)
    assert bus.name == "emulated"
    assert len(adapter.transactions) == 1
    assert adapter.transactions[0][0] is message
    assert adapter.timeouts == [3], "an emulated one waits as long as a real one"


def test_a_wedged_transfer_costs_30_ms_and_not_a_second() -> None:
    # Without the ioctl the i2c core waits for its second: 330 frames (hardware.md 3.2).
    clock, faults = VirtualClock(), SceneFaults(())
    mux = EmulatedTca9548a(0x70, {})
    adapter = EmulatedI2cAdapter([mux], clock, 400_000, FaultyWires(faults, "test"))
    with faults.inject("scl_low", "bus"):
        with pytest.raises(OSError):  # noqa: PT011  # any of the bus's
            adapter.i2c_rdwr(i2c_msg.write(0x70, [1]))
        assert clock.now_ns() == 1_000_000_000
        bus = open_bus("emulated", adapter)
        with pytest.raises(BusFaultError, match="ETIMEDOUT"):
            bus.transfer(i2c_msg.write(0x70, [1]))
    assert clock.now_ns() == 1_030_000_000
    assert mux.connected_mask == 0, "nothing got through"


def test_an_adapter_that_knows_no_time_out_is_closed_again(
    pi: Pi, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(fd: int, request: int, value: int) -> int:
        raise OSError(errno.ENOTTY, "not a typewriter")

    monkeypatch.setattr("devices.buses.i2c.fcntl.ioctl", refuse)
    with pytest.raises(BusSetupError, match="ENOTTY"):
        open_bus("/dev/i2c-1")
    assert pi.closed >= 1


# An adapter that goes away


def test_a_lost_adapter_is_closed_at_once_and_opened_again_by_its_path(pi: Pi) -> None:
    bus, message = open_bus("/dev/i2c-1"), i2c_msg.write(0x70, [1])
    pi.error = OSError(errno.ENODEV, "unplugged")
    with pytest.raises(BusLostError):
        bus.transfer(message)
    assert pi.closed == 1, "an open file keeps its number from the adapter that comes back"
    with pytest.raises(BusLostError):
        bus.transfer(message)
    assert (pi.closed, len(pi.transactions)) == (1, 0)
    pi.error = None
    assert until(lambda: bus.ensure_open(0))
    bus.transfer(message)
    assert pi.opened == ["/dev/i2c-1"] * 2
    assert len(pi.transactions) == 1
    assert len(pi.ioctls) == 2, "its time-out is set again"


def test_why_an_adapter_cannot_be_opened_again_is_said(
    pi: Pi, monkeypatch: pytest.MonkeyPatch
) -> None:
    bus = open_bus("/dev/i2c-1")
    pi.error = OSError(errno.ENODEV, "unplugged")
    with pytest.raises(BusLostError):
        bus.transfer(i2c_msg.write(0x70, [1]))

    def denied(self: SMBus, name: str) -> None:
        raise PermissionError(errno.EACCES, "Permission denied", name)

    with monkeypatch.context() as patch:
        patch.setattr(SMBus, "open", denied)
        assert until(lambda: not bus.ensure_open(0) and bus.reopen_error != "")
    assert "group i2c" in bus.reopen_error


# A patient bus


class Hesitant(BrokenAdapter):
    """Nobody acknowledges the first so many transactions."""

    def __init__(self, deaf: int) -> None:
        super().__init__(OSError(errno.EREMOTEIO, "nobody"))
        self.deaf = deaf
        self.asked = 0

    def i2c_rdwr(self, *i2c_msgs: i2c_msg) -> None:
        self.asked += 1
        if self.asked <= self.deaf:
            raise self.error


@pytest.mark.parametrize("deaf", range(4))
def test_a_patient_bus_asks_up_to_four_times_and_counts_what_then_went_well(deaf: int) -> None:
    bus = RetryingBus(I2cBus(adapter := Hesitant(deaf), "emulated"))
    bus.transfer(i2c_msg.write(0x70, [0]))
    assert (adapter.asked, bus.retried_transfers) == (deaf + 1, int(deaf > 0))
    bus.transfer(i2c_msg.write(0x70, [0]))
    assert (adapter.asked, bus.retried_transfers) == (deaf + 2, int(deaf > 0))


def test_who_is_not_there_is_no_disturbance() -> None:
    bus = RetryingBus(I2cBus(adapter := Hesitant(100), "emulated"))
    with pytest.raises(NoAcknowledgeError):
        bus.transfer(i2c_msg.write(0x77, [0]))
    assert (adapter.asked, bus.retried_transfers) == (4, 0)
