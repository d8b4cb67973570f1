"""The emulated servo of Protocol 1.0, byte by byte."""

from __future__ import annotations

import struct

import pytest

from devices.chips.dynamixel.protocol import PROTOCOL_1, ErrorFlag, Instruction
from devices.clock import VirtualClock
from devices.errors import UsageError
from tests.builders.servo import FaultyServo
from tests.devices.emulation.chips.servo_lines import PING, PING_1, line_1, spoiled

PING_OLD = bytes.fromhex("FFFF 01 02 01 FB")  # hardware.md 5.1
READ_OLD = bytes.fromhex("FFFF 01 04 02 24 02 D2")


def test_an_old_servo_answers_a_ping_without_data() -> None:
    with line_1() as (line, _, _):
        assert line.ask(PING_OLD) == (1, 0, b"")
        assert line.ask(PROTOCOL_1.encode_packet(0xFE, PING)) == (1, 0, b"")


def test_an_old_servos_control_table_says_how_it_is_set_up() -> None:
    with line_1(servo_id=253, model="MX-28", return_delay_us=20, status_return_level=1) as (
        line,
        _,
        _,
    ):
        _, _, table = line.ask(PROTOCOL_1.encode_read_request(253, 0, 74))
    assert table[:6] == bytes([29, 0, 42, 253, 1, 10])
    assert table[16] == 1
    assert table[36:38] == struct.pack("<h", -5)


def test_an_old_servo_takes_the_time_of_the_wire() -> None:
    with line_1() as (line, _, clock):
        assert line.ask(READ_OLD) == (1, 0, struct.pack("<h", -5))
        assert clock.now_ns() == 1_000 + 80_000 + 500_000 + 80_000


@pytest.mark.parametrize(("counts", "seen"), [(28_673, 28_672), (-(2**31), -28_672), (-1, -1)])
def test_an_old_servo_goes_no_further_than_seven_turns(counts: int, seen: int) -> None:
    with line_1(counts) as (line, _, _):
        assert line.ask(READ_OLD) == (1, 0, struct.pack("<h", seen))


@pytest.mark.parametrize(
    ("request_", "error"),
    [
        (PROTOCOL_1.encode_packet(1, 0x77), ErrorFlag.INSTRUCTION),
        (PROTOCOL_1.encode_packet(1, 0x03, bytes([24, 1])), ErrorFlag.INSTRUCTION),
        (PROTOCOL_1.encode_packet(1, 0x92, bytes([0, 2, 1, 36])), ErrorFlag.INSTRUCTION),
        (spoiled(PING_OLD), ErrorFlag.CHECKSUM),
        (spoiled(READ_OLD), ErrorFlag.CHECKSUM),
        (PROTOCOL_1.encode_read_request(1, 73, 2), ErrorFlag.RANGE),
        (PROTOCOL_1.encode_read_request(1, 36, 0), ErrorFlag.RANGE),
        (PROTOCOL_1.encode_packet(1, Instruction.READ, b"\x24"), ErrorFlag.RANGE),
    ],
)
def test_what_an_old_servo_cannot_do_is_answered_with_an_error_bit(
    request_: bytes, error: ErrorFlag
) -> None:
    with line_1() as (line, servo, _):
        assert line.ask(request_) == (1, error, b"")
        with servo.alert():
            assert line.ask(request_) == (1, error | ErrorFlag.VOLTAGE, b"")


@pytest.mark.parametrize(
    "request_",
    [
        b"\x00\x01\x02\xff",
        PING_1,
        PROTOCOL_1.encode_packet(2, PING),
        spoiled(PROTOCOL_1.encode_packet(2, PING)),
        spoiled(PROTOCOL_1.encode_packet(0xFE, PING)),
        PROTOCOL_1.encode_read_request(0xFE, 36, 2),
        PROTOCOL_1.encode_packet(0xFE, 0x92, bytes([0, 2, 1, 36])),
    ],
    ids=[
        "garbage",
        "protocol 2 ping",
        "another id",
        "another id, wrong sum",
        "broadcast ping, wrong sum",
        "broadcast read",
        "bulk read",
    ],
)
def test_what_does_not_concern_an_old_servo_is_ignored(request_: bytes) -> None:
    with line_1() as (line, _, _):
        assert line.ask(request_ + PROTOCOL_1.encode_read_request(1, 3, 1)) == (1, 0, b"\x01")


@pytest.mark.parametrize("level", [0, 1, 2])
@pytest.mark.parametrize(
    ("request_", "from_level", "answer"),
    [
        (READ_OLD, 1, (1, 0, struct.pack("<h", -5))),
        (PROTOCOL_1.encode_packet(1, 0x77), 2, (1, ErrorFlag.INSTRUCTION, b"")),
        (PROTOCOL_1.encode_packet(1, 0x82), 2, (1, ErrorFlag.INSTRUCTION, b"")),
    ],
    ids=["read", "unknown", "sync read, which 1.0 has not"],
)
def test_the_status_return_level_says_what_an_old_servo_answers(
    level: int, request_: bytes, from_level: int, answer: tuple[int, int, bytes]
) -> None:
    with line_1(status_return_level=level) as (line, _, _):
        first = line.ask(request_ + PING_OLD)
    assert first == (answer if level >= from_level else (1, 0, b""))


def test_a_rate_that_no_old_servo_has_is_refused() -> None:
    with pytest.raises(UsageError, match="at 4000000 baud in protocol 1"):
        FaultyServo(lambda _: 0, VirtualClock(), protocol=1, baudrate=4_000_000)
