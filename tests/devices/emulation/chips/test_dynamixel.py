"""The emulated servo of Protocol 2.0 byte by byte, and both protocols against ROBOTIS's own SDK."""

from __future__ import annotations

import contextlib
import os
import struct
import threading
from collections.abc import Iterator
from typing import Any

import dynamixel_sdk as sdk
import pytest
import serial

from devices.chips.dynamixel.packets import Instruction, PacketDecoder
from devices.chips.dynamixel.protocol1 import PROTOCOL_1, Error
from devices.chips.dynamixel.protocol2 import PROTOCOL_2
from devices.clock import SystemClock, VirtualClock
from devices.errors import UsageError
from tests.builders.servo import FaultyServo

PING = Instruction.PING
PING_1 = bytes.fromhex("FFFFFD00 01 0300 01 194E")
SYNC_READ_1_2 = bytes.fromhex("FFFFFD00 FE 0900 82 84000400 0102 CEFA")
PONG = bytes.fromhex("37 01 2A")  # model number 311, firmware 42


class Line:
    """Raw bytes to and from a servo; whoever waits in vain fails after five seconds."""

    def __init__(self, servo: FaultyServo, baudrate: int = 1_000_000) -> None:
        self.port = serial.Serial(servo.port, baudrate, timeout=5, write_timeout=5)

    def ask(self, request: bytes) -> tuple[int, int, bytes]:
        """Id, error number and data of the first status that comes back."""
        self.port.write(request)
        decoder = PacketDecoder(PROTOCOL_2)
        while True:
            data = self.port.read(decoder.missing)
            assert data, "no answer"
            for packet in decoder.feed(data):
                assert packet.intact
                assert packet.instruction == Instruction.STATUS
                return packet.servo_id, packet.parameters[0], packet.parameters[1:]


@contextlib.contextmanager
def line_to(servo: FaultyServo, baudrate: int = 1_000_000) -> Iterator[Line]:
    line = Line(servo, baudrate)
    with contextlib.closing(line.port):
        yield line


@pytest.fixture
def servo() -> Iterator[FaultyServo]:
    with FaultyServo(lambda _: -5, VirtualClock()) as servo:
        yield servo


@pytest.fixture
def line(servo: FaultyServo) -> Iterator[Line]:
    with line_to(servo) as line:
        yield line


def spoiled(packet: bytes) -> bytes:
    return packet[:-1] + bytes([packet[-1] ^ 1])


def test_a_ping_returns_model_and_firmware(line: Line) -> None:
    assert line.ask(PING_1) == (1, 0, PONG)
    assert line.ask(PROTOCOL_2.pack(0xFE, PING)) == (1, 0, PONG)


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
        _, _, table = line.ask(PROTOCOL_2.read_request(7, 0, 147))
    assert table[:2] == bytes([30, 0])
    assert table[6:10] == bytes([42, 7, 1, 10])
    assert table[13] == 2
    assert table[68] == 1


def test_the_position_is_read_afresh_at_the_end_of_the_return_delay() -> None:
    clock = VirtualClock(1_000)
    with FaultyServo(lambda t_ns: t_ns, clock) as servo, line_to(servo) as line:
        _, _, data = line.ask(PROTOCOL_2.read_request(1, 132, 4))
        assert struct.unpack("<i", data) == (1_000 + 140_000 + 500_000,)
        assert clock.now_ns() == 1_000 + 140_000 + 500_000 + 150_000
        _, _, high_half = line.ask(PROTOCOL_2.read_request(1, 134, 2))
        later = 1_000 + 790_000 + 640_000
        assert high_half == struct.pack("<i", later)[2:]


def test_a_sync_read_is_answered_by_those_it_names(line: Line) -> None:
    minus_five = (1, 0, struct.pack("<i", -5))
    assert line.ask(SYNC_READ_1_2) == minus_five
    position = struct.pack("<HH", 132, 4)
    others = PROTOCOL_2.pack(0xFE, Instruction.SYNC_READ, position + b"\x02\x03")
    nobody = PROTOCOL_2.pack(0xFE, Instruction.SYNC_READ, position)
    assert line.ask(others + nobody + PING_1) == (1, 0, PONG)


@pytest.mark.parametrize(
    "request_",
    [
        b"\x00\x01\x02\xff\xff",
        bytes.fromhex("FFFF 01 02 01 FB"),
        PROTOCOL_2.pack(2, PING),
        PROTOCOL_2.pack(1, Instruction.STATUS, b"\x00"),
        spoiled(PROTOCOL_2.pack(2, PING)),
        spoiled(PROTOCOL_2.pack(0xFE, PING)),
        spoiled(SYNC_READ_1_2),
        PROTOCOL_2.read_request(0xFE, 132, 4),
        PROTOCOL_2.pack(0xFE, 0x03, bytes([64, 0, 1])),
        PROTOCOL_2.pack(0xFE, 0x8A, bytes([132, 0, 4, 0, 1])),
        PROTOCOL_2.pack(0xFE, 0x77),
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
    assert line.ask(request_ + PROTOCOL_2.read_request(1, 7, 1)) == (1, 0, b"\x01")


@pytest.mark.parametrize(
    ("request_", "error"),
    [
        (PROTOCOL_2.pack(1, 0x77), 2),
        (PROTOCOL_2.pack(1, 0x03, bytes([64, 0, 1])), 2),
        (PROTOCOL_2.pack(1, Instruction.SYNC_READ, bytes([132, 0, 4, 0, 1])), 2),
        (spoiled(PING_1), 3),
        (spoiled(PROTOCOL_2.read_request(1, 132, 4)), 3),
        (PROTOCOL_2.read_request(1, 660, 4), 4),
        (PROTOCOL_2.read_request(1, 0xFFFF, 0xFFFF), 4),
        (PROTOCOL_2.read_request(1, 132, 0), 5),
        (PROTOCOL_2.pack(1, Instruction.READ, b"\x84\x00"), 5),
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
        assert line.ask(PROTOCOL_2.read_request(1, 70, 1)) == (1, 0x80, b"\x01")
        assert line.ask(PROTOCOL_2.pack(1, 0x77)) == (1, 0x82, b"")
    assert line.ask(PROTOCOL_2.read_request(1, 70, 1)) == (1, 0, b"\x00")


@pytest.mark.parametrize("level", [0, 1, 2])
@pytest.mark.parametrize(
    ("request_", "from_level", "answer"),
    [
        (PROTOCOL_2.read_request(1, 132, 4), 1, (1, 0, struct.pack("<i", -5))),
        (SYNC_READ_1_2, 1, (1, 0, struct.pack("<i", -5))),
        (PROTOCOL_2.pack(1, 0x77), 2, (1, 2, b"")),
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


# ROBOTIS's SDK


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
            data = self.port.read(decoder.missing)
            assert data, "no answer"
            for packet in decoder.feed(data):
                assert packet.intact
                return packet.servo_id, packet.instruction, packet.parameters


@contextlib.contextmanager
def line_1(counts: int = -5, **options: Any) -> Iterator[tuple[Line1, FaultyServo, VirtualClock]]:
    clock = VirtualClock(1_000)
    with FaultyServo(lambda _: counts, clock, protocol=1, **options) as servo:
        line = Line1(servo)
        with contextlib.closing(line.port):
            yield line, servo, clock


PING_OLD = bytes.fromhex("FFFF 01 02 01 FB")  # hardware.md 5.1
READ_OLD = bytes.fromhex("FFFF 01 04 02 24 02 D2")


def test_an_old_servo_answers_a_ping_without_data() -> None:
    with line_1() as (line, _, _):
        assert line.ask(PING_OLD) == (1, 0, b"")
        assert line.ask(PROTOCOL_1.pack(0xFE, PING)) == (1, 0, b"")


def test_an_old_servos_control_table_says_how_it_is_set_up() -> None:
    with line_1(servo_id=253, model="MX-28", return_delay_us=20, status_return_level=1) as (
        line,
        _,
        _,
    ):
        _, _, table = line.ask(PROTOCOL_1.read_request(253, 0, 74))
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
        (PROTOCOL_1.pack(1, 0x77), Error.INSTRUCTION),
        (PROTOCOL_1.pack(1, 0x03, bytes([24, 1])), Error.INSTRUCTION),
        (PROTOCOL_1.pack(1, 0x92, bytes([0, 2, 1, 36])), Error.INSTRUCTION),
        (spoiled(PING_OLD), Error.CHECKSUM),
        (spoiled(READ_OLD), Error.CHECKSUM),
        (PROTOCOL_1.read_request(1, 73, 2), Error.RANGE),
        (PROTOCOL_1.read_request(1, 36, 0), Error.RANGE),
        (PROTOCOL_1.pack(1, Instruction.READ, b"\x24"), Error.RANGE),
    ],
)
def test_what_an_old_servo_cannot_do_is_answered_with_an_error_bit(
    request_: bytes, error: Error
) -> None:
    with line_1() as (line, servo, _):
        assert line.ask(request_) == (1, error, b"")
        with servo.alert():
            assert line.ask(request_) == (1, error | Error.VOLTAGE, b"")


@pytest.mark.parametrize(
    "request_",
    [
        b"\x00\x01\x02\xff",
        PING_1,
        PROTOCOL_1.pack(2, PING),
        spoiled(PROTOCOL_1.pack(2, PING)),
        spoiled(PROTOCOL_1.pack(0xFE, PING)),
        PROTOCOL_1.read_request(0xFE, 36, 2),
        PROTOCOL_1.pack(0xFE, 0x92, bytes([0, 2, 1, 36])),
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
        assert line.ask(request_ + PROTOCOL_1.read_request(1, 3, 1)) == (1, 0, b"\x01")


@pytest.mark.parametrize("level", [0, 1, 2])
@pytest.mark.parametrize(
    ("request_", "from_level", "answer"),
    [
        (READ_OLD, 1, (1, 0, struct.pack("<h", -5))),
        (PROTOCOL_1.pack(1, 0x77), 2, (1, Error.INSTRUCTION, b"")),
        (PROTOCOL_1.pack(1, 0x82), 2, (1, Error.INSTRUCTION, b"")),
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
