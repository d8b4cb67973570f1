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
def sdk_port(position: int, protocol: int) -> Iterator[tuple[sdk.PortHandler, FaultyServo]]:
    with FaultyServo(lambda _: position, SystemClock(), protocol=protocol) as servo:
        port = sdk.PortHandler(servo.port)
        assert port.setBaudRate(1_000_000)
        yield port, servo
        port.closePort()


@pytest.fixture(autouse=True)
def patient_sdk(monkeypatch: pytest.MonkeyPatch) -> None:
    # The SDK waits for twice this many milliseconds, in real time. No test waits for its end.
    monkeypatch.setattr("dynamixel_sdk.port_handler.LATENCY_TIMER", 1000)


def test_the_makers_sdk_reads_a_servo_of_protocol_2() -> None:
    packets = sdk.PacketHandler(2.0)
    with sdk_port(-5, 2) as (port, _):
        assert packets.ping(port, 1) == (311, sdk.COMM_SUCCESS, 0)
        value, result, error = packets.read4ByteTxRx(port, 1, 132)
        assert (result, error) == (sdk.COMM_SUCCESS, 0)
        assert struct.unpack("<i", struct.pack("<I", value)) == (-5,)
        group = sdk.GroupSyncRead(port, packets, 132, 4)
        assert group.addParam(1)
        assert group.txRxPacket() == sdk.COMM_SUCCESS
        assert group.getData(1, 132, 4) == 2**32 - 5
        result, error = packets.write1ByteTxRx(port, 1, 64, 1)
        assert result == sdk.COMM_SUCCESS
        assert "Undefined instruction" in packets.getRxPacketError(error)


def test_the_makers_sdk_reads_a_servo_of_protocol_1() -> None:
    packets = sdk.PacketHandler(1.0)
    with sdk_port(-4097, 1) as (port, servo):
        assert packets.ping(port, 1) == (310, sdk.COMM_SUCCESS, 0)
        value, result, error = packets.read2ByteTxRx(port, 1, 36)
        assert (result, error) == (sdk.COMM_SUCCESS, 0)
        assert struct.unpack("<h", struct.pack("<H", value)) == (-4097,)
        result, error = packets.write1ByteTxRx(port, 1, 24, 1)
        assert result == sdk.COMM_SUCCESS
        assert "Instruction code error" in packets.getRxPacketError(error)
        with servo.alert():
            again, result, error = packets.read2ByteTxRx(port, 1, 36)
        assert (again, result) == (value, sdk.COMM_SUCCESS)
        assert "Input voltage error" in packets.getRxPacketError(error)
