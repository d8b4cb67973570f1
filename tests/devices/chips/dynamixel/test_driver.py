"""The driver against bytes, and against a servo behind a pseudo-terminal on a virtual clock."""

from __future__ import annotations

import contextlib
import pickle

import pytest
import serial
from hypothesis import given
from hypothesis import strategies as st

from devices.chips.dynamixel.driver import DynamixelServo, ServoIdentity, open_servo
from devices.chips.dynamixel.protocol import PROTOCOL_1, PROTOCOL_2, ErrorFlag, Instruction
from devices.clock import VirtualClock
from devices.errors import ServoPacketError, ServoSetupError, ServoStatusError, ServoTimeoutError
from tests.builders.servo import FaultyServo
from tests.devices.chips.dynamixel.lines import SHORT_S, both_protocols, emulated

# hardware.md 5.1, from the e-manual
PING_1 = bytes.fromhex("FFFFFD00 01 0300 01 194E")
READ_POSITION_OF_1 = bytes.fromhex("FFFFFD00 01 0700 02 84000400 1D15")
STATUS_OF_1_AT_166 = bytes.fromhex("FFFFFD00 01 0800 55 00 A6000000 8CC0")
STATUS_OF_2_AT_2079 = bytes.fromhex("FFFFFD00 02 0800 55 00 1F080000 BABE")


class ScriptedPort:
    """A serial port that answers any request with the same bytes, in pieces of `piece`."""

    def __init__(self, answer: bytes, *, piece: int = 1000, stale: bytes = b"") -> None:
        self.answer = answer
        self.piece = piece
        self.incoming = stale
        self.written = b""
        self.reads = 0

    def write(self, data: bytes, /) -> int:
        self.written += data
        self.incoming += self.answer
        return len(data)

    def read(self, size: int, /) -> bytes:
        self.reads += 1
        n = min(size, self.piece)
        data, self.incoming = self.incoming[:n], self.incoming[n:]
        return data

    def reset_input_buffer(self) -> None:
        self.incoming = b""

    def close(self) -> None:
        pass


class LatePort(ScriptedPort):
    """A port that reports that it could not send in time, as on a machine that was busy."""

    def write(self, data: bytes, /) -> int:
        raise serial.SerialTimeoutException("Write timeout")


def test_a_request_that_was_not_sent_in_time_is_a_silence_and_no_lost_port() -> None:
    with pytest.raises(ServoTimeoutError):
        servo_on(LatePort(b"")).read_position()


class ShortPort(ScriptedPort):
    """A port that takes one byte less than it is given, and answers all the same."""

    def write(self, data: bytes, /) -> int:
        return super().write(data) - 1


def test_a_request_that_was_not_sent_whole_has_no_answer() -> None:
    with pytest.raises(ServoSetupError, match="13 of 14 bytes sent"):
        servo_on(ShortPort(STATUS_OF_1_AT_166)).read_position()


def servo_on(
    port: ScriptedPort, clock: VirtualClock | None = None, *, protocol: int = 2
) -> DynamixelServo:
    return DynamixelServo(
        port,
        clock or VirtualClock(),
        servo_id=1,
        baudrate=1_000_000,
        timeout_s=SHORT_S,
        protocol=protocol,
    )


def status(*parameters: int, servo_id: int = 1) -> bytes:
    return PROTOCOL_2.encode_packet(servo_id, Instruction.STATUS, bytes(parameters))


def status_1(error: int, *data: int, servo_id: int = 1) -> bytes:
    return PROTOCOL_1.encode_packet(servo_id, error, bytes(data))


# The driver against scripted bytes


def test_the_driver_sends_the_golden_requests() -> None:
    port = ScriptedPort(STATUS_OF_1_AT_166)
    assert servo_on(port).read_position().counts == 166
    assert port.written == READ_POSITION_OF_1
    port = ScriptedPort(status(0, 55, 1, 42))
    assert servo_on(port).read_identity() == ServoIdentity(311, 42)
    assert port.written == PING_1


@pytest.mark.parametrize("piece", [1, 3, 7, 14])
def test_an_answer_may_come_in_pieces(piece: int) -> None:
    port = ScriptedPort(b"\xff\xff\xff\xfd" + STATUS_OF_1_AT_166, piece=piece)
    assert servo_on(port).read_position().counts == 166


def test_what_came_before_the_request_is_discarded() -> None:
    port = ScriptedPort(STATUS_OF_1_AT_166, stale=status(0, 9, 9, 9, 9))
    assert servo_on(port).read_position().counts == 166


def test_the_echo_of_a_one_wire_adapter_is_passed_over() -> None:
    port = ScriptedPort(READ_POSITION_OF_1 + STATUS_OF_1_AT_166)
    assert servo_on(port).read_position().counts == 166


def test_an_answer_of_another_servo_is_refused() -> None:
    with pytest.raises(ServoPacketError, match="servo 2 answered; expected servo 1"):
        servo_on(ScriptedPort(STATUS_OF_2_AT_2079)).read_position()


@pytest.mark.parametrize("parameters", [(), (0,), (0, 1, 2, 3), (0, 1, 2, 3, 4, 5)])
def test_an_answer_of_another_length_is_refused(parameters: tuple[int, ...]) -> None:
    with pytest.raises(ServoPacketError, match=r"answer of . bytes; expected 4 bytes"):
        servo_on(ScriptedPort(status(*parameters))).read_position()


@pytest.mark.parametrize(
    ("error", "text"),
    [(1, "result fail"), (7, "access"), (0x84, "error 4, data range"), (9, "error 9, unknown")],
)
def test_an_error_number_is_an_error_that_says_what_it_means(error: int, text: str) -> None:
    with pytest.raises(ServoStatusError, match=text):
        servo_on(ScriptedPort(status(error))).read_position()


def test_an_alert_alone_is_no_error() -> None:
    reading = servo_on(ScriptedPort(status(0x80, 0xFB, 0xFF, 0xFF, 0xFF))).read_position()
    assert (reading.counts, reading.has_alert) == (-5, True)


def test_silence_is_a_timeout_that_says_what_to_check_and_takes_its_time() -> None:
    clock = VirtualClock(7)
    with pytest.raises(ServoTimeoutError, match="no answer within 20 ms") as caught:
        servo_on(ScriptedPort(b""), clock).read_identity()
    for thing in ("power", "its id", "baud rate", "latency timer"):
        assert thing in str(caught.value)
    assert clock.now_ns() == 7 + 20_000_000
    assert isinstance(caught.value, TimeoutError)
    assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)  # noqa: S301  # our own


def test_half_an_answer_is_a_timeout_that_tells_of_it() -> None:
    with pytest.raises(ServoTimeoutError, match="9 bytes came"):
        servo_on(ScriptedPort(STATUS_OF_1_AT_166[:9])).read_position()


def test_an_answer_after_the_timeout_is_none() -> None:
    clock = VirtualClock()

    class LatePort(ScriptedPort):
        def read(self, size: int, /) -> bytes:
            clock.sleep_until_ns(clock.now_ns() + 21_000_000)
            return super().read(size)

    with pytest.raises(ServoTimeoutError):
        servo_on(LatePort(STATUS_OF_1_AT_166), clock).read_position()


@pytest.mark.parametrize("garbage", [b"\xff", b"\x00", b"\xff\xff\xfd\x00\x01\x00\x04"])
def test_garbage_that_never_ends_is_given_up_though_the_clock_stands_still(garbage: bytes) -> None:
    port = ScriptedPort(garbage * 10_000)
    with pytest.raises(ServoPacketError, match="no status packet"):
        servo_on(port).read_position()
    assert port.reads <= 256


def test_garbage_that_never_ends_is_given_up_when_the_time_is_over() -> None:
    clock = VirtualClock()

    class SlowPort(ScriptedPort):
        def read(self, size: int, /) -> bytes:
            clock.sleep_until_ns(clock.now_ns() + 1_000_000)
            return super().read(size)

    port = SlowPort(b"\xaa" * 10_000, piece=1)
    with pytest.raises(ServoTimeoutError, match="20 bytes came"):
        servo_on(port, clock).read_position()


def test_an_instant_answer_has_no_negative_uncertainty() -> None:
    reading = servo_on(ScriptedPort(STATUS_OF_1_AT_166)).read_position()
    assert reading.half_width_ns == 0


# Protocol 1.0 against scripted bytes

# hardware.md 5.1; three bytes are asked for, see devices.chips.dynamixel.protocol
READ_3_FROM_36 = bytes.fromhex("FFFF 01 04 02 24 03 D1")
READ_3_FROM_0 = bytes.fromhex("FFFF 01 04 02 00 03 F5")
STATUS_1_AT_548 = status_1(0, 0x24, 0x02, 0)


def test_the_driver_sends_the_requests_of_protocol_1() -> None:
    port = ScriptedPort(STATUS_1_AT_548)
    assert servo_on(port, protocol=1).read_position().counts == 548
    assert port.written == READ_3_FROM_36
    port = ScriptedPort(status_1(0, 0x36, 0x01, 41))
    assert servo_on(port, protocol=1).read_identity() == ServoIdentity(310, 41)
    assert port.written == READ_3_FROM_0


@pytest.mark.parametrize(
    "noise", ["", "00", "FF", "FF FF", "00 FF 01", "FF FF 01 00", "FFFF FE FF"]
)
@pytest.mark.parametrize("piece", [1, 2, 3, 5, 100])
@pytest.mark.parametrize("echo", [b"", READ_3_FROM_36])
def test_noise_and_echo_before_an_answer_of_protocol_1_are_passed_over(
    noise: str, piece: int, echo: bytes
) -> None:
    port = ScriptedPort(echo + bytes.fromhex(noise) + STATUS_1_AT_548, piece=piece)
    assert servo_on(port, protocol=1).read_position().counts == 548


@given(
    position=st.integers(0, 0xFFFF),
    next_byte=st.integers(0, 255),
    error=st.integers(0, 127).filter(lambda bits: not bits & ~ErrorFlag.ALERT),
    asked=st.sampled_from(["read_position", "identify"]),
)
def test_no_answer_of_protocol_1_can_pass_for_an_echo(
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


def test_an_echo_alone_is_no_answer() -> None:
    for protocol, echo in ((1, READ_3_FROM_36), (2, READ_POSITION_OF_1)):
        with pytest.raises(ServoTimeoutError, match=f"{len(echo)} bytes came"):
            servo_on(ScriptedPort(echo), protocol=protocol).read_position()


@pytest.mark.parametrize(
    "bit", [ErrorFlag.VOLTAGE, ErrorFlag.ANGLE, ErrorFlag.OVERHEAT, ErrorFlag.OVERLOAD]
)
def test_a_servo_of_protocol_1_that_complains_of_its_state_gives_its_position(
    bit: ErrorFlag,
) -> None:
    port = ScriptedPort(status_1(bit, 0xFB, 0xFF, 0))
    reading = servo_on(port, protocol=1).read_position()
    assert (reading.counts, reading.has_alert) == (-5, True)


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (0x08, "refused: range"),
        (0x10, "refused: checksum of the request"),
        (0x40, "refused: undefined instruction"),
        (0x80, "refused: unknown"),
        (0x49, "refused: range, undefined instruction"),
    ],
)
def test_a_servo_of_protocol_1_that_refuses_says_why(error: int, text: str) -> None:
    for data in ((), (0, 0, 0)):
        with pytest.raises(ServoStatusError, match=text):
            servo_on(ScriptedPort(status_1(error, *data)), protocol=1).read_position()


def test_an_answer_of_protocol_1_is_checked() -> None:
    for answer, text in (
        (STATUS_1_AT_548[:-1] + b"\x00", "damaged"),
        (status_1(0, 1, 2, 3, servo_id=2), "servo 2 answered; expected servo 1"),
        (status_1(0, 1, 2), "answer of 2 bytes; expected 3 bytes"),
    ):
        with pytest.raises(ServoPacketError, match=text):
            servo_on(ScriptedPort(answer), protocol=1).read_position()


# The port


def test_a_port_that_is_not_there_is_a_setup_error_with_a_remedy() -> None:
    with pytest.raises(ServoSetupError, match="group dialout"):
        open_servo("/dev/no-such-port", baudrate=57_600, clock=VirtualClock())


@pytest.mark.parametrize(("port", "baudrate"), [("/dev/null", 57_600), (None, -1)])
def test_what_is_no_serial_port_or_no_baud_rate_is_a_setup_error(
    port: str | None, baudrate: int
) -> None:
    with (
        FaultyServo(lambda _: 0, VirtualClock()) as servo,
        pytest.raises(ServoSetupError, match="cannot be opened"),
    ):
        open_servo(port or servo.port, baudrate=baudrate, clock=VirtualClock())


def test_a_port_has_one_user() -> None:
    with emulated() as (servo, _, clock), pytest.raises(ServoSetupError, match="cannot be opened"):
        open_servo(servo.port, baudrate=1_000_000, clock=clock)


def test_a_plug_that_is_pulled_is_a_setup_error() -> None:
    with emulated() as (servo, driver, _):
        assert driver.read_identity().model_number == 311
        servo.close()
        with pytest.raises(ServoSetupError, match="serial port failed"):
            driver.read_position()


# Who is there


@pytest.mark.parametrize("model", ["MX-28", "MX-64"])
@both_protocols
def test_the_servo_of_the_scene_is_opened_without_a_remark(model: str, protocol: int) -> None:
    clock = VirtualClock()
    with FaultyServo(lambda _: 7, clock, model=model, protocol=protocol) as servo:
        driver = open_servo(
            servo.port, baudrate=1_000_000, clock=clock, model=model, protocol=protocol
        )
        with contextlib.closing(driver):
            assert driver.opening_warnings == ()
            assert driver.read_position().counts == 7


@both_protocols
def test_another_model_is_refused_and_the_key_to_set_is_named(protocol: int) -> None:
    with (
        FaultyServo(lambda _: 0, VirtualClock(), model="MX-28", protocol=protocol) as servo,
        pytest.raises(ServoSetupError, match=r'expected an MX-64 .* Set model = "MX-28"'),
    ):
        open_servo(servo.port, baudrate=1_000_000, clock=VirtualClock(), protocol=protocol)


def test_a_new_firmware_that_speaks_the_old_protocol_is_refused_with_the_remedy() -> None:
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


@pytest.mark.parametrize("asked", [1, 2])
def test_a_servo_of_the_other_protocol_is_silent_which_is_a_remark(asked: int) -> None:
    clock = VirtualClock()
    with FaultyServo(lambda _: 0, clock, protocol=3 - asked) as servo:
        driver = open_servo(
            servo.port, baudrate=1_000_000, clock=clock, timeout_s=SHORT_S, protocol=asked
        )
        with contextlib.closing(driver):
            (remark,) = driver.opening_warnings
    assert "no answer" in remark
    assert f"that its firmware speaks Protocol {asked}.0" in remark


@both_protocols
def test_a_servo_that_is_silent_at_first_is_opened_and_read_once_it_answers(protocol: int) -> None:
    clock = VirtualClock()
    with FaultyServo(lambda _: -4097, clock, protocol=protocol) as servo:
        with servo.silent():
            driver = open_servo(
                servo.port, baudrate=1_000_000, clock=clock, timeout_s=0.5, protocol=protocol
            )
        with contextlib.closing(driver):
            assert len(driver.opening_warnings) == 1
            assert driver.read_position().counts == -4097


def test_a_slow_adapter_is_a_remark(monkeypatch: pytest.MonkeyPatch) -> None:
    remark = "devices.chips.dynamixel.driver.check_latency_timer"
    monkeypatch.setattr(remark, lambda port: f"{port} is slow")
    with emulated() as (servo, driver, _):
        assert driver.opening_warnings == (f"{servo.port} is slow",)


def test_a_port_whose_servo_is_refused_is_free_again() -> None:
    with FaultyServo(lambda _: 0, VirtualClock(), model="MX-28") as servo:
        for model, refused in (("MX-64", True), ("MX-28", False)):
            with contextlib.ExitStack() as stack:
                if refused:
                    stack.enter_context(pytest.raises(ServoSetupError, match="answers"))
                open_servo(
                    servo.port, baudrate=1_000_000, clock=VirtualClock(), model=model
                ).close()
