"""The I2C bus: classes of its errors, and the calls of a real adapter."""

from __future__ import annotations

import ctypes
import errno
import os
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from smbus2 import SMBus, i2c_msg

from devices.buses.device_files import ATTEMPT_INTERVAL_NS
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
    I2cError,
    NoAcknowledgeError,
    UsageError,
)
from devices.flags import TileFlag
from tests.devices.rigs import Adapter
from tests.waiting import until


class BrokenAdapter(Adapter):
    """Its first transactions, or all, fail with one error."""

    def __init__(self, error: OSError, failures: int = 1_000) -> None:
        self.error = error
        self.failures = failures
        self.transfers = 0

    def i2c_rdwr(self, *i2c_msgs: i2c_msg) -> None:
        self.transfers += 1
        if self.transfers <= self.failures:
            raise self.error


# hardware.md 3.3: numbers as on Linux, so that a wrong table cannot hide behind the names
@pytest.mark.parametrize(
    ("number", "name", "kind", "remedy"),
    [
        (6, "ENXIO", NoAcknowledgeError, "mux channel"),
        (121, "EREMOTEIO", NoAcknowledgeError, "mux channel"),
        (5, "EIO", BusFaultError, "SDA and SCL"),
        (110, "ETIMEDOUT", BusFaultError, "SDA and SCL"),
        (11, "EAGAIN", BusFaultError, "SDA and SCL"),
        (16, "EBUSY", BusFaultError, "SDA and SCL"),
        (22, "EINVAL", BusMisuseError, ""),
        (95, "EOPNOTSUPP", BusMisuseError, ""),
        (19, "ENODEV", BusLostError, "plug"),
        (2, "ENOENT", BusLostError, "plug"),
        (13, "EACCES", BusLostError, "plug"),
        (108, "ESHUTDOWN", BusLostError, "plug"),
        (None, "the adapter melted", BusLostError, "plug"),
    ],
)
def test_an_errno_is_a_fault_of_the_device_the_bus_or_the_caller(
    number: int | None, name: str, kind: type[I2cError], remedy: str
) -> None:
    cause = OSError(name) if number is None else OSError(number, os.strerror(number))
    with pytest.raises(I2cError) as caught:
        I2cBus(BrokenAdapter(cause), "/dev/i2c-7").transfer(
            i2c_msg.write(0x73, [0]), i2c_msg.read(0x73, 1)
        )
    error = caught.value
    assert error.__cause__ is cause
    assert type(error) is kind
    assert str(error).startswith("/dev/i2c-7, address 0x73: ")
    assert error.errno == number
    assert name in str(error) or errno.errorcode.get(number or 0, "?") in str(error)
    assert remedy in error.remedy
    assert kind is not BusMisuseError or "42 messages" in error.expected


class Pi:
    """A machine on which smbus2 opens any bus; records transactions and other ioctls."""

    def __init__(self) -> None:
        self.opened: list[str] = []
        self.transactions: list[tuple[i2c_msg, ...]] = []
        self.ioctls: list[tuple[int, int, int]] = []
        self.closed = 0
        self.error: OSError | None = None
        self.done: int | None = None
        """Number of messages that a transaction transfers; None: all."""

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


class RecordingAdapter(Adapter):
    """An adapter that records its calls."""

    def __init__(self) -> None:
        self.transactions: list[tuple[i2c_msg, ...]] = []
        self.timeouts: list[int] = []

    def i2c_rdwr(self, *i2c_msgs: i2c_msg) -> None:
        self.transactions.append(i2c_msgs)

    def set_timeout(self, units_10ms: int) -> None:
        self.timeouts.append(units_10ms)


def test_messages_reach_a_real_bus_unchanged_in_one_transaction_with_a_timeout_of_30_ms(
    pi: Pi,
) -> None:
    other = RecordingAdapter()
    bus = open_bus("/dev/i2c-1", other)
    write, read = i2c_msg.write(0x60, [0x00]), i2c_msg.read(0x60, 4)
    bus.transfer(write, read)
    bus.transfer(write)
    expected = [(0x60, 0, b"\x00"), (0x60, 1, b"\xff" * 4)]
    sent = [[(m.addr, m.flags, bytes(m)) for m in messages] for messages in pi.transactions]
    assert sent == [expected, expected[:1]]
    assert other.transactions == [], "the path of a device is never an emulated bus"
    assert (bus.name, pi.opened, pi.closed) == ("/dev/i2c-1", ["/dev/i2c-1"], 0)
    # include/uapi/linux/i2c-dev.h: I2C_TIMEOUT, in units of 10 ms; the adapter keeps it
    assert pi.ioctls == [(77, 0x0702, 3)]
    bus.close()
    assert pi.closed == 1


@pytest.mark.parametrize("done", [0, 1])
def test_fewer_messages_than_requested_are_no_acknowledge(pi: Pi, done: int) -> None:
    bus = open_bus("/dev/i2c-1")
    pi.done = done
    with pytest.raises(NoAcknowledgeError) as caught:
        bus.transfer(i2c_msg.write(0x60, [0x00]), i2c_msg.read(0x60, 4))
    assert caught.value.errno == errno.EREMOTEIO
    assert f"{done} of 2 messages" in str(caught.value.__cause__)


@given(stale=st.binary(min_size=1, max_size=16))
def test_bytes_of_an_earlier_read_are_never_a_reading(stale: bytes) -> None:
    read = i2c_msg.read(0x60, len(stale))
    ctypes.memmove(read.buf, stale, len(stale))
    bus = I2cBus(RecordingAdapter(), "/dev/i2c-7")
    bus.transfer(read)  # which fills nothing in
    assert bytes(read) == b"\xff" * len(stale)
    driver = Mpl115a2(bus)
    assert driver.classify_counts(*driver.read_counts()) == TileFlag.IMPLAUSIBLE


def refuse_to_open(self: SMBus, name: str) -> None:
    raise PermissionError(errno.EACCES, "Permission denied", name)


def test_a_bus_that_cannot_be_opened_is_a_setup_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    missing = str(tmp_path / "i2c-9")
    with pytest.raises(BusSetupError, match="i2c_arm=on") as caught:
        open_bus(missing)
    assert (caught.value.where, caught.value.errno) == (missing, errno.ENOENT)
    (tmp_path / "notes.txt").write_text("not an adapter")
    with pytest.raises(BusSetupError, match="ENOTTY"):
        open_bus(str(tmp_path / "notes.txt"))
    monkeypatch.setattr(SMBus, "open", refuse_to_open)
    with pytest.raises(BusSetupError, match=r"EACCES.*group i2c"):
        open_bus("/dev/i2c-1")


def test_an_adapter_that_refuses_the_timeout_is_closed(pi: Pi) -> None:
    pi.error = OSError(errno.ENOTTY, "not a typewriter")
    with pytest.raises(BusSetupError, match="ENOTTY"):
        open_bus("/dev/i2c-1")
    assert pi.closed >= 1


def test_an_emulated_bus_uses_the_adapter_that_it_is_given() -> None:
    adapter = RecordingAdapter()
    message = i2c_msg.write(0x70, [1])
    bus = open_bus("emulated", adapter)
    bus.transfer(message)
    assert bus.name == "emulated"
    assert [sent[0] is message for sent in adapter.transactions] == [True]
    assert adapter.timeouts == [3], "as a real one"
    with pytest.raises(UsageError, match="emulated") as caught:
        open_bus("emulated")
    assert caught.value.exit_code == 2


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
    assert mux.connected_mask == 0


def test_a_lost_adapter_is_closed_at_once_and_reopened_by_its_path(
    pi: Pi, monkeypatch: pytest.MonkeyPatch
) -> None:
    bus, message = open_bus("/dev/i2c-1"), i2c_msg.write(0x70, [1])
    pi.error = OSError(errno.ENODEV, "unplugged")
    for _ in range(2):
        with pytest.raises(BusLostError):
            bus.transfer(message)
        # An open file would keep its number from the adapter that returns.
        assert (pi.closed, len(pi.transactions)) == (1, 0)
    pi.error = None
    with monkeypatch.context() as patch:
        patch.setattr(SMBus, "open", refuse_to_open)
        assert until(lambda: not bus.ensure_open(0) and bus.reopen_error != "")
    assert "group i2c" in bus.reopen_error
    assert until(lambda: bus.ensure_open(ATTEMPT_INTERVAL_NS))
    bus.transfer(message)
    assert pi.opened == ["/dev/i2c-1"] * 2
    assert len(pi.transactions) == 1
    assert len(pi.ioctls) == 2, "its timeout is set again"


@pytest.mark.parametrize("failures", range(4))
def test_a_retrying_bus_repeats_a_transfer_up_to_four_times_and_counts_successes(
    failures: int,
) -> None:
    adapter = BrokenAdapter(OSError(errno.EREMOTEIO, "no acknowledge"), failures)
    bus = RetryingBus(I2cBus(adapter, "emulated"))
    for transfers in (failures + 1, failures + 2):
        bus.transfer(i2c_msg.write(0x70, [0]))
        assert (adapter.transfers, bus.retried_transfers) == (transfers, int(failures > 0))


def test_a_retrying_bus_does_not_count_an_absent_device() -> None:
    adapter = BrokenAdapter(OSError(errno.EREMOTEIO, "no acknowledge"))
    bus = RetryingBus(I2cBus(adapter, "emulated"))
    with pytest.raises(NoAcknowledgeError):
        bus.transfer(i2c_msg.write(0x77, [0]))
    assert (adapter.transfers, bus.retried_transfers) == (4, 0)
