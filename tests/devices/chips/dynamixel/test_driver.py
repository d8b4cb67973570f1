"""The driver on a port that answers with scripted bytes; restarts of a servo by its clock."""

from __future__ import annotations

import pytest
import serial
from hypothesis import given
from hypothesis import strategies as st

from devices.chips.dynamixel.driver import (
    TICK_PERIOD,
    DynamixelServo,
    RestartDetector,
    ServoIdentity,
)
from devices.chips.dynamixel.protocol import PROTOCOL_1, PROTOCOL_2, ErrorFlag, Instruction
from devices.clock import VirtualClock
from devices.errors import ServoPacketError, ServoSetupError, ServoStatusError, ServoTimeoutError
from tests.devices.chips.dynamixel.lines import SHORT_S

MS = 1_000_000

# hardware.md 5.1, from the e-manual
READ_POSITION_OF_1 = bytes.fromhex("FFFFFD00 01 0700 02 84000400 1D15")
STATUS_OF_1_AT_166 = bytes.fromhex("FFFFFD00 01 0800 55 00 A6000000 8CC0")
STATUS_OF_2_AT_2079 = bytes.fromhex("FFFFFD00 02 0800 55 00 1F080000 BABE")


class ScriptedPort:
    """A serial port that answers any request with the same bytes, in pieces of `piece`.

    Of a request it sends all but `unsent` bytes, and each read takes `read_ns`.
    """

    def __init__(
        self,
        answer: bytes,
        *,
        piece: int = 1000,
        stale: bytes = b"",
        unsent: int = 0,
        read_ns: int = 0,
    ) -> None:
        self.answer = answer
        self.piece = piece
        self.incoming = stale
        self.unsent = unsent
        self.read_ns = read_ns
        self.reads = 0
        self.clock = VirtualClock(7)

    def write(self, data: bytes, /) -> int:
        self.incoming += self.answer
        return len(data) - self.unsent

    def read(self, size: int, /) -> bytes:
        self.reads += 1
        self.clock.sleep_until_ns(self.clock.now_ns() + self.read_ns)
        n = min(size, self.piece)
        data, self.incoming = self.incoming[:n], self.incoming[n:]
        return data

    def reset_input_buffer(self) -> None:
        self.incoming = b""

    def close(self) -> None:
        pass


def servo_on(port: ScriptedPort, *, protocol: int = 2) -> DynamixelServo:
    return DynamixelServo(
        port,
        port.clock,
        servo_id=1,
        baudrate=1_000_000,
        timeout_s=SHORT_S,
        protocol=protocol,
    )


def status(*parameters: int, servo_id: int = 1) -> bytes:
    return PROTOCOL_2.encode_packet(servo_id, Instruction.STATUS, bytes(parameters))


def status_1(error: int, *data: int, servo_id: int = 1) -> bytes:
    return PROTOCOL_1.encode_packet(servo_id, error, bytes(data))


# hardware.md 5.1; three bytes are requested, see devices.chips.dynamixel.protocol
READ_3_FROM_36 = bytes.fromhex("FFFF 01 04 02 24 03 D1")
STATUS_1_AT_548 = status_1(0, 0x24, 0x02, 0)


# Both protocols


@pytest.mark.parametrize("piece", [1, 2, 3, 7, 100])
@pytest.mark.parametrize(
    ("protocol", "before", "answer", "counts"),
    [
        *(
            (2, before, STATUS_OF_1_AT_166, 166)
            for before in (b"", b"\xff\xff\xff\xfd", READ_POSITION_OF_1)
        ),
        *(
            (1, echo + bytes.fromhex(noise), STATUS_1_AT_548, 548)
            for echo in (b"", READ_3_FROM_36)
            for noise in ("", "FF", "FF FF", "00 FF 01", "FF FF 01 00", "FFFF FE FF")
        ),
    ],
)
def test_noise_and_echo_before_an_answer_are_ignored(
    protocol: int, before: bytes, answer: bytes, counts: int, piece: int
) -> None:
    stale = status(0, 9, 9, 9, 9) + status_1(0, 9, 9, 9)
    port = ScriptedPort(before + answer, piece=piece, stale=stale)
    assert servo_on(port, protocol=protocol).read_position().counts == counts


@pytest.mark.parametrize(
    ("protocol", "answer", "error", "text"),
    [
        (2, STATUS_OF_2_AT_2079, ServoPacketError, "servo 2 answered; expected servo 1"),
        *(
            (2, status(*data), ServoPacketError, r"answer of . bytes; expected 4 bytes")
            for data in ((), (0,), (0, 1, 2, 3), (0, 1, 2, 3, 4, 5))
        ),
        (2, status(1), ServoStatusError, "result fail"),
        (2, status(7), ServoStatusError, "access"),
        (2, status(0x84), ServoStatusError, "error 4, data range"),
        (2, status(9), ServoStatusError, "error 9, unknown"),
        (2, STATUS_OF_1_AT_166[:9], ServoTimeoutError, "9 bytes came"),
        (2, READ_POSITION_OF_1, ServoTimeoutError, "14 bytes came"),  # an echo alone
        *(
            (1, status_1(bits, *data), ServoStatusError, f"refused: {text}")
            for bits, text in (
                (0x08, "range"),
                (0x10, "checksum of the request"),
                (0x40, "undefined instruction"),
                (0x80, "unknown"),
                (0x49, "range, undefined instruction"),
            )
            for data in ((), (0, 0, 0))
        ),
        (1, STATUS_1_AT_548[:-1] + b"\x00", ServoPacketError, "damaged"),
        (
            1,
            status_1(0, 1, 2, 3, servo_id=2),
            ServoPacketError,
            "servo 2 answered; expected servo 1",
        ),
        (1, status_1(0, 1, 2), ServoPacketError, "answer of 2 bytes; expected 3 bytes"),
        (1, READ_3_FROM_36, ServoTimeoutError, "8 bytes came"),  # an echo alone
    ],
)
def test_a_wrong_answer_is_refused_with_the_reason(
    protocol: int, answer: bytes, error: type[Exception], text: str
) -> None:
    with pytest.raises(error, match=text):
        servo_on(ScriptedPort(answer), protocol=protocol).read_position()


def test_a_timeout_takes_its_time_and_names_its_possible_causes() -> None:
    port = ScriptedPort(b"")
    with pytest.raises(ServoTimeoutError, match="no answer within 20 ms") as caught:
        servo_on(port).read_identity()
    for thing in ("power", "its id", "baud rate", "latency timer"):
        assert thing in str(caught.value)
    assert port.clock.now_ns() == 7 + 20 * MS


def test_an_answer_after_the_timeout_is_not_used() -> None:
    with pytest.raises(ServoTimeoutError):
        servo_on(ScriptedPort(STATUS_OF_1_AT_166, read_ns=21 * MS)).read_position()


@pytest.mark.parametrize("garbage", [b"\xff", b"\x00", b"\xff\xff\xfd\x00\x01\x00\x04"])
def test_endless_garbage_ends_the_reading_although_the_clock_stands_still(garbage: bytes) -> None:
    port = ScriptedPort(garbage * 10_000)
    with pytest.raises(ServoPacketError, match="no status packet"):
        servo_on(port).read_position()
    assert port.reads <= 256


def test_endless_garbage_ends_with_the_timeout() -> None:
    port = ScriptedPort(b"\xaa" * 10_000, piece=1, read_ns=MS)
    with pytest.raises(ServoTimeoutError, match="20 bytes came"):
        servo_on(port).read_position()


def test_a_request_that_is_not_sent_in_time_is_a_timeout_and_no_lost_port(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def time_out(self: ScriptedPort, data: bytes) -> int:
        raise serial.SerialTimeoutException("Write timeout")

    monkeypatch.setattr(ScriptedPort, "write", time_out)
    with pytest.raises(ServoTimeoutError):
        servo_on(ScriptedPort(b"")).read_position()


def test_a_request_that_is_sent_in_part_has_no_answer() -> None:
    with pytest.raises(ServoSetupError, match="13 of 14 bytes sent"):
        servo_on(ScriptedPort(STATUS_OF_1_AT_166, unsent=1)).read_position()


# Protocol 1.0


@given(
    position=st.integers(0, 0xFFFF),
    next_byte=st.integers(0, 255),
    error=st.integers(0, 127).filter(lambda bits: not bits & ~ErrorFlag.ALERT),
    asked=st.sampled_from(["read_position", "identify"]),
)
def test_no_answer_of_protocol_1_is_taken_for_an_echo(
    position: int, next_byte: int, error: int, asked: str
) -> None:
    answer = status_1(error, *position.to_bytes(2, "little"), next_byte)
    servo = servo_on(ScriptedPort(answer), protocol=1)
    if asked == "identify":
        assert servo.read_identity() == ServoIdentity(position, next_byte)
    else:
        reading = servo.read_position()
        assert reading.counts == (position if position < 0x8000 else position - 0x10000)
        assert reading.has_alert == bool(error)


def test_a_new_firmware_of_the_old_protocol_is_refused_with_the_remedy() -> None:
    # Its Protocol Type is 1: the old protocol over the new control table, where 36 is no position.
    servo = servo_on(ScriptedPort(status_1(0, 0x37, 0x01, 42)), protocol=1)
    with pytest.raises(ServoSetupError, match=r"MX-64 with firmware for Protocol 2\.0") as caught:
        servo.check_model("MX-64")
    assert "Its firmware speaks Protocol 2.0" in str(caught.value)
    assert "protocol = 2" in str(caught.value)


def test_a_servo_of_another_kind_is_refused_by_its_number() -> None:
    servo = servo_on(ScriptedPort(status(0, 0x06, 0x04, 40)))
    with pytest.raises(ServoSetupError, match=r"model number 1030 answers; expected .* 311"):
        servo.check_model("MX-64")


# Restarts, by the milliseconds since power-up


@given(
    started=st.integers(0, TICK_PERIOD - 1),
    waits_ms=st.lists(st.integers(1, 5_000), min_size=1, max_size=40),
    pace=st.floats(0.97, 1.03),
)
def test_a_running_servo_has_not_restarted(started: int, waits_ms: list[int], pace: float) -> None:
    detector, t_ms = RestartDetector(), 0
    detector.detect_restart(started, 0, silent_ns=0)
    for wait_ms in waits_ms:
        t_ms += wait_ms
        tick = int(started + pace * t_ms) % TICK_PERIOD
        assert not detector.detect_restart(tick, t_ms * MS, silent_ns=0)


@given(
    before=st.integers(0, TICK_PERIOD - 1),
    silent_ms=st.integers(50, 200_000),
    on_part=st.floats(0, 1),
    pace=st.floats(0.97, 1.03),
)
def test_a_restart_within_a_silence_is_always_detected(
    before: int, silent_ms: int, on_part: float, pace: float
) -> None:
    detector = RestartDetector()
    detector.detect_restart(before, 0, silent_ns=0)
    tick = int(on_part * silent_ms * min(pace, 1.0)) % TICK_PERIOD
    assert detector.detect_restart(tick, silent_ms * MS, silent_ns=silent_ms * MS)


@given(before=st.integers(0, TICK_PERIOD - 1), silent_ms=st.integers(50, 10_000))
def test_a_silence_of_the_line_alone_is_no_restart(before: int, silent_ms: int) -> None:
    detector = RestartDetector()
    detector.detect_restart(before, 0, silent_ns=0)
    tick = (before + silent_ms) % TICK_PERIOD
    restarted = detector.detect_restart(tick, silent_ms * MS, silent_ns=silent_ms * MS)
    # A tick that also fits a restart counts as one.
    assert restarted == (tick <= silent_ms + 20)


def test_a_silence_counts_as_a_restart_without_the_register() -> None:
    for tick in (None, 0):
        detector = RestartDetector()
        detector.detect_restart(tick, 0, silent_ns=0)
        assert not detector.detect_restart(tick, 1_000 * MS, silent_ns=0)
        assert detector.detect_restart(tick, 1_200 * MS, silent_ns=110 * MS)
