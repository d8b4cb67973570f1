"""The emulated servo of both protocols against ROBOTIS's own SDK."""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Iterator

import dynamixel_sdk as sdk
import pytest

from devices.clock import SystemClock
from tests.builders.servo import FaultyServo


@contextlib.contextmanager
def sdk_port_to(servo: FaultyServo) -> Iterator[sdk.PortHandler]:
    with servo:
        port = sdk.PortHandler(servo.port)
        assert port.setBaudRate(1_000_000)
        yield port
        port.closePort()


@pytest.fixture(autouse=True)
def patient_sdk(monkeypatch: pytest.MonkeyPatch) -> None:
    # It gives up after twice this many milliseconds of wall clock, busy all the while: ample for a
    # busy machine. Nothing here waits for it to give up.
    monkeypatch.setattr("dynamixel_sdk.port_handler.LATENCY_TIMER", 1000)


@pytest.fixture
def sdk_port() -> Iterator[sdk.PortHandler]:
    with sdk_port_to(FaultyServo(lambda _: -5, SystemClock())) as port:
        yield port


def test_the_makers_sdk_finds_and_reads_the_servo(sdk_port: sdk.PortHandler) -> None:
    packets = sdk.PacketHandler(2.0)
    assert packets.ping(sdk_port, 1) == (311, sdk.COMM_SUCCESS, 0)
    value, result, error = packets.read4ByteTxRx(sdk_port, 1, 132)
    assert (result, error) == (sdk.COMM_SUCCESS, 0)
    assert struct.unpack("<i", struct.pack("<I", value)) == (-5,)


def test_the_makers_sdk_reads_it_by_sync_read(sdk_port: sdk.PortHandler) -> None:
    group = sdk.GroupSyncRead(sdk_port, sdk.PacketHandler(2.0), 132, 4)
    assert group.addParam(1)
    assert group.txRxPacket() == sdk.COMM_SUCCESS
    assert group.getData(1, 132, 4) == 2**32 - 5


def test_the_makers_sdk_understands_its_errors(sdk_port: sdk.PortHandler) -> None:
    packets = sdk.PacketHandler(2.0)
    result, error = packets.write1ByteTxRx(sdk_port, 1, 64, 1)
    assert result == sdk.COMM_SUCCESS
    assert "Undefined instruction" in packets.getRxPacketError(error)


def test_the_makers_sdk_finds_and_reads_an_old_servo() -> None:
    packets = sdk.PacketHandler(1.0)
    with sdk_port_to(FaultyServo(lambda _: -4097, SystemClock(), protocol=1)) as port:
        assert packets.ping(port, 1) == (310, sdk.COMM_SUCCESS, 0)
        value, result, error = packets.read2ByteTxRx(port, 1, 36)
        assert (result, error) == (sdk.COMM_SUCCESS, 0)
        assert struct.unpack("<h", struct.pack("<H", value)) == (-4097,)


def test_the_makers_sdk_understands_the_errors_of_an_old_servo() -> None:
    packets = sdk.PacketHandler(1.0)
    servo = FaultyServo(lambda _: 7, SystemClock(), protocol=1)
    with sdk_port_to(servo) as port:
        result, error = packets.write1ByteTxRx(port, 1, 24, 1)
        assert result == sdk.COMM_SUCCESS
        assert "Instruction code error" in packets.getRxPacketError(error)
        with servo.alert():
            value, result, error = packets.read2ByteTxRx(port, 1, 36)
        assert (value, result) == (7, sdk.COMM_SUCCESS)
        assert "Input voltage error" in packets.getRxPacketError(error)
