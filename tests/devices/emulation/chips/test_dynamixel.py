"""The emulated servo of Protocol 2.0, byte by byte."""

from __future__ import annotations

import os
import struct
import threading
from collections.abc import Iterator

import pytest

from devices.chips.dynamixel.protocol import PROTOCOL_2, Instruction
from devices.clock import VirtualClock
from devices.errors import UsageError
from tests.builders.servo import FaultyServo
from tests.devices.emulation.chips.servo_lines import PING, PING_1, Line, line_to, spoiled

SYNC_READ_1_2 = bytes.fromhex("FFFFFD00 FE 0900 82 84000400 0102 CEFA")
PONG = bytes.fromhex("37 01 2A")  # model number 311, firmware 42


@pytest.fixture
def servo() -> Iterator[FaultyServo]:
    with FaultyServo(lambda _: -5, VirtualClock()) as servo:
        yield servo


@pytest.fixture
def line(servo: FaultyServo) -> Iterator[Line]:
    with line_to(servo) as line:
        yield line


def test_a_ping_returns_model_and_firmware(line: Line) -> None:
    assert line.ask(PING_1) == (1, 0, PONG)
    assert line.ask(PROTOCOL_2.encode_packet(0xFE, PING)) == (1, 0, PONG)


def test_the_control_table_says_how_the_servo_is_set_up() -> None:
    with (
        FaultyServo(
            lambda _: 0,
            VirtualClock(),
            servo_id=7,
            model="MX-28",
            baudrate=57_600,
            return_delay_us=20,
            status_return_level=1,
        ) as servo,
        line_to(servo, 57_600) as line,
    ):
        _, _, table = line.ask(PROTOCOL_2.encode_read_request(7, 0, 147))
    assert table[:2] == bytes([30, 0])
    assert table[6:10] == bytes([42, 7, 1, 10])
    assert table[13] == 2
    assert table[68] == 1


def test_the_position_is_read_afresh_at_the_end_of_the_return_delay() -> None:
    clock = VirtualClock(1_000)
    with FaultyServo(lambda t_ns: t_ns, clock) as servo, line_to(servo) as line:
        _, _, data = line.ask(PROTOCOL_2.encode_read_request(1, 132, 4))
        assert struct.unpack("<i", data) == (1_000 + 140_000 + 500_000,)
        assert clock.now_ns() == 1_000 + 140_000 + 500_000 + 150_000
        _, _, high_half = line.ask(PROTOCOL_2.encode_read_request(1, 134, 2))
        later = 1_000 + 790_000 + 640_000
        assert high_half == struct.pack("<i", later)[2:]


def test_a_sync_read_is_answered_by_those_it_names(line: Line) -> None:
    minus_five = (1, 0, struct.pack("<i", -5))
    assert line.ask(SYNC_READ_1_2) == minus_five
    position = struct.pack("<HH", 132, 4)
    others = PROTOCOL_2.encode_packet(0xFE, Instruction.SYNC_READ, position + b"\x02\x03")
    nobody = PROTOCOL_2.encode_packet(0xFE, Instruction.SYNC_READ, position)
    assert line.ask(others + nobody + PING_1) == (1, 0, PONG)


@pytest.mark.parametrize(
    "request_",
    [
        b"\x00\x01\x02\xff\xff",
        bytes.fromhex("FFFF 01 02 01 FB"),
        PROTOCOL_2.encode_packet(2, PING),
        PROTOCOL_2.encode_packet(1, Instruction.STATUS, b"\x00"),
        spoiled(PROTOCOL_2.encode_packet(2, PING)),
        spoiled(PROTOCOL_2.encode_packet(0xFE, PING)),
        spoiled(SYNC_READ_1_2),
        PROTOCOL_2.encode_read_request(0xFE, 132, 4),
        PROTOCOL_2.encode_packet(0xFE, 0x03, bytes([64, 0, 1])),
        PROTOCOL_2.encode_packet(0xFE, 0x8A, bytes([132, 0, 4, 0, 1])),
        PROTOCOL_2.encode_packet(0xFE, 0x77),
    ],
    ids=[
        "garbage",
        "protocol 1 ping",
        "another id",
        "a status",
        "another id, wrong CRC",
        "broadcast ping, wrong CRC",
        "sync read, wrong CRC",
        "broadcast read",
        "broadcast write",
        "fast sync read",
        "unknown broadcast",
    ],
)
def test_what_does_not_concern_it_is_ignored(line: Line, request_: bytes) -> None:
    # so that the first answer is that to the next request
    assert line.ask(request_ + PROTOCOL_2.encode_read_request(1, 7, 1)) == (1, 0, b"\x01")


@pytest.mark.parametrize(
    ("request_", "error"),
    [
        (PROTOCOL_2.encode_packet(1, 0x77), 2),
        (PROTOCOL_2.encode_packet(1, 0x03, bytes([64, 0, 1])), 2),
        (PROTOCOL_2.encode_packet(1, Instruction.SYNC_READ, bytes([132, 0, 4, 0, 1])), 2),
        (spoiled(PING_1), 3),
        (spoiled(PROTOCOL_2.encode_read_request(1, 132, 4)), 3),
        (PROTOCOL_2.encode_read_request(1, 660, 4), 4),
        (PROTOCOL_2.encode_read_request(1, 0xFFFF, 0xFFFF), 4),
        (PROTOCOL_2.encode_read_request(1, 132, 0), 5),
        (PROTOCOL_2.encode_packet(1, Instruction.READ, b"\x84\x00"), 5),
    ],
)
def test_what_it_cannot_do_is_answered_with_an_error_number(
    line: Line, request_: bytes, error: int
) -> None:
    assert line.ask(request_) == (1, error, b"")


def test_an_alert_shows_in_the_error_byte_and_in_the_hardware_error_status(
    servo: FaultyServo, line: Line
) -> None:
    with servo.alert():
        assert line.ask(PROTOCOL_2.encode_read_request(1, 70, 1)) == (1, 0x80, b"\x01")
        assert line.ask(PROTOCOL_2.encode_packet(1, 0x77)) == (1, 0x82, b"")
    assert line.ask(PROTOCOL_2.encode_read_request(1, 70, 1)) == (1, 0, b"\x00")


@pytest.mark.parametrize("level", [0, 1, 2])
@pytest.mark.parametrize(
    ("request_", "from_level", "answer"),
    [
        (PROTOCOL_2.encode_read_request(1, 132, 4), 1, (1, 0, struct.pack("<i", -5))),
        (SYNC_READ_1_2, 1, (1, 0, struct.pack("<i", -5))),
        (PROTOCOL_2.encode_packet(1, 0x77), 2, (1, 2, b"")),
    ],
    ids=["read", "sync read", "unknown"],
)
def test_the_status_return_level_says_what_is_answered(
    level: int, request_: bytes, from_level: int, answer: tuple[int, int, bytes]
) -> None:
    with (
        FaultyServo(lambda _: -5, VirtualClock(), status_return_level=level) as servo,
        line_to(servo) as line,
    ):
        first = line.ask(request_ + PING_1)
    assert first == (answer if level >= from_level else (1, 0, PONG))


def test_a_rate_that_no_servo_has_is_refused() -> None:
    with pytest.raises(UsageError, match="no emulated servo runs at 123456 baud"):
        FaultyServo(lambda _: 0, VirtualClock(), baudrate=123_456)


def test_closing_leaves_neither_thread_nor_descriptor() -> None:
    def open_descriptors() -> set[str]:
        return set(os.listdir("/proc/self/fd"))

    descriptors, threads = open_descriptors(), threading.active_count()
    for _ in range(3):
        with FaultyServo(lambda _: 0, VirtualClock()) as servo, line_to(servo) as line:
            assert line.ask(PING_1) == (1, 0, PONG)
        servo.close()
    assert open_descriptors() == descriptors
    assert threading.active_count() == threads


def test_nobody_need_listen_for_the_servo_to_close(servo: FaultyServo, line: Line) -> None:
    with servo.garbage_before_reply(bytes(1_000_000)):
        line.port.write(PING_1)
        assert line.port.read(1) == b"\x00"
        servo.close()


def test_a_reader_may_come_again(servo: FaultyServo) -> None:
    for _ in range(3):
        with line_to(servo) as line:
            assert line.ask(PING_1) == (1, 0, PONG)
