"""Raw bytes to and from an emulated servo, in both protocols."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import serial

from devices.chips.dynamixel.protocol import PROTOCOL_1, PROTOCOL_2, Instruction, PacketDecoder
from devices.clock import VirtualClock
from tests.builders.servo import FaultyServo

PING = Instruction.PING
PING_1 = bytes.fromhex("FFFFFD00 01 0300 01 194E")


class Line:
    """Raw bytes to and from a servo; whoever waits in vain fails after five seconds."""

    def __init__(self, servo: FaultyServo, baudrate: int = 1_000_000) -> None:
        self.port = serial.Serial(servo.port, baudrate, timeout=5, write_timeout=5)

    def ask(self, request: bytes) -> tuple[int, int, bytes]:
        """Id, error number and data of the first status that comes back."""
        self.port.write(request)
        decoder = PacketDecoder(PROTOCOL_2)
        while True:
            data = self.port.read(decoder.min_missing_bytes)
            assert data, "no answer"
            for packet in decoder.decode_bytes(data):
                assert packet.is_intact
                assert packet.instruction == Instruction.STATUS
                return packet.servo_id, packet.parameters[0], packet.parameters[1:]


@contextlib.contextmanager
def line_to(servo: FaultyServo, baudrate: int = 1_000_000) -> Iterator[Line]:
    line = Line(servo, baudrate)
    with contextlib.closing(line.port):
        yield line


def spoiled(packet: bytes) -> bytes:
    return packet[:-1] + bytes([packet[-1] ^ 1])


# Protocol 1.0


class Line1:
    """Raw bytes to and from a servo of Protocol 1.0, on a virtual clock."""

    def __init__(self, servo: FaultyServo) -> None:
        self.port = serial.Serial(servo.port, 1_000_000, timeout=5, write_timeout=5)

    def ask(self, request: bytes) -> tuple[int, int, bytes]:
        """Id, error byte and data of the first status that comes back."""
        self.port.write(request)
        decoder = PacketDecoder(PROTOCOL_1)
        while True:
            data = self.port.read(decoder.min_missing_bytes)
            assert data, "no answer"
            for packet in decoder.decode_bytes(data):
                assert packet.is_intact
                return packet.servo_id, packet.instruction, packet.parameters


@contextlib.contextmanager
def line_1(counts: int = -5, **options: Any) -> Iterator[tuple[Line1, FaultyServo, VirtualClock]]:
    clock = VirtualClock(1_000)
    with FaultyServo(lambda _: counts, clock, protocol=1, **options) as servo:
        line = Line1(servo)
        with contextlib.closing(line.port):
            yield line, servo, clock
