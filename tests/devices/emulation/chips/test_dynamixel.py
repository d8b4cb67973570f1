"""The emulated servo of both protocols, byte by byte."""

from __future__ import annotations

import contextlib
import os
import struct
import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import serial

from devices.chips.dynamixel.protocol import (
    PROTOCOL_1,
    PROTOCOL_2,
    ErrorFlag,
    Instruction,
    PacketDecoder,
)
from devices.clock import VirtualClock
from devices.errors import UsageError
from tests.builders.servo import FaultyServo

PING, READ = Instruction.PING, Instruction.READ
# hardware.md 5.1
PING_1 = bytes.fromhex("FFFF 01 02 01 FB")
READ_1 = bytes.fromhex("FFFF 01 04 02 24 02 D2")
PING_2 = bytes.fromhex("FFFFFD00 01 0300 01 194E")
READ_2 = PROTOCOL_2.encode_read_request(1, 132, 4)
PONG_2 = bytes.fromhex("37 01 2A")  # model number 311, firmware 42

encode_1, encode_2 = PROTOCOL_1.encode_packet, PROTOCOL_2.encode_packet


class Line:
    """Raw bytes to and from a servo. A missing answer is an error after five seconds."""

    def __init__(
        self, servo: FaultyServo, clock: VirtualClock, protocol: int, baudrate: int
    ) -> None:
        self.servo = servo
        self.clock = clock
        self.protocol = PROTOCOL_1 if protocol == 1 else PROTOCOL_2
        self.port = serial.Serial(servo.port, baudrate, timeout=5, write_timeout=5)

    def ask(self, request: bytes) -> tuple[int, int, bytes]:
        """Return id, error byte and data of the first status after a request."""
        self.port.write(request)
        decoder = PacketDecoder(self.protocol)
        while True:
            data = self.port.read(decoder.min_missing_bytes)
            assert data, "no answer"
            for packet in decoder.decode_bytes(data):
                assert packet.is_intact
                if self.protocol is PROTOCOL_1:
                    return packet.servo_id, packet.instruction, packet.parameters
                assert packet.instruction == Instruction.STATUS
                return packet.servo_id, packet.parameters[0], packet.parameters[1:]


@contextlib.contextmanager
def line_to(
    counts: int | Callable[[int], int] = -5,
    *,
    protocol: int = 2,
    baudrate: int = 1_000_000,
    **options: Any,
) -> Iterator[Line]:
    """Open a line to a servo at these counts, which may be a function of the time in ns."""
    clock = VirtualClock(1_000)
    position = counts if callable(counts) else lambda _: counts
    with FaultyServo(position, clock, protocol=protocol, baudrate=baudrate, **options) as servo:
        line = Line(servo, clock, protocol, baudrate)
        with contextlib.closing(line.port):
            yield line


def damage(packet: bytes) -> bytes:
    return packet[:-1] + bytes([packet[-1] ^ 1])


# Answers


def test_a_ping_returns_model_and_firmware_in_protocol_2_only() -> None:
    with line_to(protocol=1) as line:
        assert line.ask(PING_1) == line.ask(encode_1(0xFE, PING)) == (1, 0, b"")
    with line_to() as line:
        assert line.ask(PING_2) == line.ask(encode_2(0xFE, PING)) == (1, 0, PONG_2)


def test_the_control_table_has_the_settings_of_the_servo() -> None:
    options: dict[str, Any] = {"model": "MX-28", "return_delay_us": 20, "status_return_level": 1}
    with line_to(protocol=1, servo_id=253, **options) as line:
        _, _, table = line.ask(PROTOCOL_1.encode_read_request(253, 0, 74))
    assert table[:6] == bytes([29, 0, 42, 253, 1, 10])
    assert table[16] == 1
    assert table[36:38] == struct.pack("<h", -5)
    with line_to(servo_id=7, baudrate=57_600, **options) as line:
        _, _, table = line.ask(PROTOCOL_2.encode_read_request(7, 0, 147))
    assert table[:2] == bytes([30, 0])
    assert table[6:10] == bytes([42, 7, 1, 10])
    assert table[13] == 2
    assert table[68] == 1


def test_the_position_is_sampled_at_the_end_of_the_return_delay() -> None:
    with line_to(lambda t_ns: t_ns) as line:
        _, _, data = line.ask(READ_2)
        assert struct.unpack("<i", data) == (1_000 + 140_000 + 500_000,)
        assert line.clock.now_ns() == 1_000 + 140_000 + 500_000 + 150_000
        _, _, high_half = line.ask(PROTOCOL_2.encode_read_request(1, 134, 2))
        later = 1_000 + 790_000 + 640_000
        assert high_half == struct.pack("<i", later)[2:]


def test_an_answer_of_protocol_1_takes_the_time_of_the_wire() -> None:
    with line_to(protocol=1) as line:
        assert line.ask(READ_1) == (1, 0, struct.pack("<h", -5))
        assert line.clock.now_ns() == 1_000 + 80_000 + 500_000 + 80_000


@pytest.mark.parametrize(("counts", "seen"), [(28_673, 28_672), (-(2**31), -28_672), (-1, -1)])
def test_a_servo_of_protocol_1_counts_seven_turns(counts: int, seen: int) -> None:
    with line_to(counts, protocol=1) as line:
        assert line.ask(READ_1) == (1, 0, struct.pack("<h", seen))


@pytest.mark.parametrize(
    ("protocol", "requests"),
    [
        (
            1,
            {
                "garbage": b"\x00\x01\x02\xff",
                "a ping of protocol 2": PING_2,
                "another id": encode_1(2, PING),
                "another id, wrong sum": damage(encode_1(2, PING)),
                "broadcast ping, wrong sum": damage(encode_1(0xFE, PING)),
                "broadcast read": PROTOCOL_1.encode_read_request(0xFE, 36, 2),
            },
        ),
        (
            2,
            {
                "garbage": b"\x00\x01\x02\xff\xff",
                "a ping of protocol 1": PING_1,
                "another id": encode_2(2, PING),
                "a status": encode_2(1, Instruction.STATUS, b"\x00"),
                "another id, wrong CRC": damage(encode_2(2, PING)),
                "broadcast ping, wrong CRC": damage(encode_2(0xFE, PING)),
                "broadcast read": PROTOCOL_2.encode_read_request(0xFE, 132, 4),
            },
        ),
    ],
)
def test_a_request_to_other_servos_is_not_answered(
    protocol: int, requests: dict[str, bytes]
) -> None:
    with line_to(protocol=protocol) as line:
        own = line.protocol.encode_read_request(1, {1: 3, 2: 7}[protocol], 1)
        for name, request in requests.items():
            assert line.ask(request + own) == (1, 0, b"\x01"), name


@pytest.mark.parametrize(
    ("request_", "error"),
    [
        (encode_1(1, 0x77), ErrorFlag.INSTRUCTION),
        (damage(PING_1), ErrorFlag.CHECKSUM),
        (damage(READ_1), ErrorFlag.CHECKSUM),
        (PROTOCOL_1.encode_read_request(1, 73, 2), ErrorFlag.RANGE),
        (PROTOCOL_1.encode_read_request(1, 36, 0), ErrorFlag.RANGE),
        (encode_1(1, READ, b"\x24"), ErrorFlag.RANGE),
        (encode_2(1, 0x77), 2),
        (damage(PING_2), 3),
        (damage(READ_2), 3),
        (PROTOCOL_2.encode_read_request(1, 660, 4), 4),
        (PROTOCOL_2.encode_read_request(1, 0xFFFF, 0xFFFF), 4),
        (PROTOCOL_2.encode_read_request(1, 132, 0), 5),
        (encode_2(1, READ, b"\x84\x00"), 5),
    ],
)
def test_an_unsupported_request_is_answered_with_an_error(request_: bytes, error: int) -> None:
    protocol = 2 if request_.startswith(PROTOCOL_2.header) else 1
    alert = ErrorFlag.VOLTAGE if protocol == 1 else 0x80
    with line_to(protocol=protocol) as line:
        assert line.ask(request_) == (1, error, b"")
        with line.servo.alert():
            assert line.ask(request_) == (1, error | alert, b"")


def test_an_alert_of_protocol_2_shows_in_the_hardware_error_status() -> None:
    with line_to() as line:
        with line.servo.alert():
            assert line.ask(PROTOCOL_2.encode_read_request(1, 70, 1)) == (1, 0x80, b"\x01")
        assert line.ask(PROTOCOL_2.encode_read_request(1, 70, 1)) == (1, 0, b"\x00")


@pytest.mark.parametrize("level", [0, 1])
@pytest.mark.parametrize(
    ("protocol", "request_", "data", "ping", "pong"),
    [
        (1, READ_1, struct.pack("<h", -5), PING_1, b""),
        (2, READ_2, struct.pack("<i", -5), PING_2, PONG_2),
    ],
)
def test_a_read_is_answered_from_status_return_level_1_on(
    level: int, protocol: int, request_: bytes, data: bytes, ping: bytes, pong: bytes
) -> None:
    with line_to(protocol=protocol, status_return_level=level) as line:
        assert line.ask(request_ + ping) == (1, 0, data if level else pong)


# Opening and closing


@pytest.mark.parametrize(
    ("protocol", "baudrate", "text"),
    [
        (2, 123_456, "no emulated servo runs at 123456 baud"),
        (1, 4_000_000, "at 4000000 baud in protocol 1"),
    ],
)
def test_a_baud_rate_of_no_servo_is_refused(protocol: int, baudrate: int, text: str) -> None:
    with pytest.raises(UsageError, match=text):
        FaultyServo(lambda _: 0, VirtualClock(), protocol=protocol, baudrate=baudrate)


def test_closing_leaves_neither_thread_nor_descriptor() -> None:
    descriptors, threads = set(os.listdir("/proc/self/fd")), threading.active_count()
    for _ in range(3):
        with line_to() as line:
            assert line.ask(PING_2) == (1, 0, PONG_2)
        line.servo.close()
    assert set(os.listdir("/proc/self/fd")) == descriptors
    assert threading.active_count() == threads


def test_a_servo_with_an_unread_answer_can_be_closed() -> None:
    with line_to() as line, line.servo.garbage_before_reply(bytes(1_000_000)):
        line.port.write(PING_2)
        assert line.port.read(1) == b"\x00"
        line.servo.close()


def test_a_port_can_be_opened_again() -> None:
    with line_to() as line:
        for _ in range(3):
            line.port.close()
            line.port.open()
            assert line.ask(PING_2) == (1, 0, PONG_2)
