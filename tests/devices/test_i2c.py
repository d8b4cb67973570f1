"""The bus: whose fault an error was, and what is done to a real adapter."""

from __future__ import annotations

import errno
import os
import pickle
from pathlib import Path

import pytest
from smbus2 import i2c_msg

from devices.errors import (
    BusFaultError,
    BusMisuseError,
    BusSetupError,
    FootTileError,
    I2cError,
    NoAcknowledgeError,
    UsageError,
)
from devices.i2c import I2cBus, open_bus


class BrokenAdapter:
    """Every transaction fails with one errno."""

    def __init__(self, error: OSError) -> None:
        self.error = error

    def i2c_rdwr(self, *i2c_msgs: i2c_msg) -> None:
        raise self.error

    def close(self) -> None:
        pass


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
    (19, "ENODEV", BusSetupError),
    (2, "ENOENT", BusSetupError),
    (13, "EACCES", BusSetupError),
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
    again = pickle.loads(pickle.dumps(error))  # noqa: S301
    for one in (error, again):
        assert type(one) is kind
        assert str(one).startswith("/dev/i2c-7, address 0x73: ")
        assert one.errno == number
    assert str(again) == str(error)


def test_an_error_without_a_number_is_not_taken_for_a_missing_tile() -> None:
    error = failure_of(OSError("the adapter melted"), i2c_msg.write(0x60, [0]))
    assert type(error) is BusSetupError
    assert "the adapter melted" in str(error)
    assert error.errno is None


def test_what_a_field_worker_can_do_is_said() -> None:
    message = i2c_msg.write(0x60, [0])
    assert "mux channel" in failure_of(OSError(121, ""), message).remedy
    assert "SDA and SCL" in failure_of(OSError(110, ""), message).remedy
    assert "i2c_arm=on" in failure_of(OSError(2, ""), message).remedy
    assert "42 messages" in failure_of(OSError(22, ""), message).expected


class FakeSmbus:
    """`smbus2.SMBus` without a device."""

    fd = 77

    def __init__(self) -> None:
        self.transactions: list[tuple[i2c_msg, ...]] = []
        self.closed = False

    def i2c_rdwr(self, *i2c_msgs: i2c_msg) -> None:
        self.transactions.append(i2c_msgs)

    def close(self) -> None:
        self.closed = True


class Pi:
    """A machine whose bus devices are all the same fake, and whose ioctls are noted."""

    def __init__(self) -> None:
        self.adapter = FakeSmbus()
        self.opened: list[str] = []
        self.ioctls: list[tuple[int, int, int]] = []

    def smbus(self, name: str) -> FakeSmbus:
        self.opened.append(name)
        return self.adapter

    def ioctl(self, fd: int, request: int, value: int) -> int:
        self.ioctls.append((fd, request, value))
        return 0


@pytest.fixture
def pi(monkeypatch: pytest.MonkeyPatch) -> Pi:
    pi = Pi()
    monkeypatch.setattr("devices.i2c.SMBus", pi.smbus)
    monkeypatch.setattr("devices.i2c.fcntl.ioctl", pi.ioctl)
    return pi


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
    first, second = pi.adapter.transactions
    assert len(first) == 2
    assert first[0] is write
    assert first[1] is read
    assert len(second) == 1
    assert second[0] is write
    assert len(pi.ioctls) == 1, "the time-out is sticky"


def test_closing_a_bus_closes_its_adapter(pi: Pi) -> None:
    bus = open_bus("/dev/i2c-1")
    assert not pi.adapter.closed
    bus.close()
    assert pi.adapter.closed


def test_a_world_is_not_asked_where_a_device_is_named(pi: Pi) -> None:
    world = FakeSmbus()
    open_bus("/dev/i2c-1", world).transfer(i2c_msg.write(0x70, [1]))
    assert world.transactions == []
    assert len(pi.adapter.transactions) == 1


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
    def locked(name: str) -> FakeSmbus:
        raise PermissionError(errno.EACCES, "Permission denied", name)

    monkeypatch.setattr("devices.i2c.SMBus", locked)
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
    adapter = FakeSmbus()
    message = i2c_msg.write(0x70, [1])
    bus = open_bus("emulated", adapter)
    bus.transfer(message)
    assert bus.name == "emulated"
    assert len(adapter.transactions) == 1
    assert adapter.transactions[0][0] is message
