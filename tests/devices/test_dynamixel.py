"""The driver against bytes, and against a servo behind a pseudo-terminal on a virtual clock."""

from __future__ import annotations

import contextlib
import itertools
import pickle
from collections.abc import Callable, Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.clock import SystemClock, VirtualClock
from devices.dynamixel import MODELS, Dynamixel, open_servo
from devices.dynamixel_packets import (
    Instruction,
    Packet,
    PacketDecoder,
    crc16,
    instruction_packet,
    read_packet,
    wire_time_ns,
)
from devices.emulation.dynamixel import EmulatedServo
from devices.errors import (
    ServoPacketError,
    ServoSetupError,
    ServoStatusError,
    ServoTimeoutError,
)

# hardware.md 5.1, from the e-manual
PING_1 = bytes.fromhex("FFFFFD00 01 0300 01 194E")
READ_POSITION_OF_1 = bytes.fromhex("FFFFFD00 01 0700 02 84000400 1D15")
STATUS_OF_1_AT_166 = bytes.fromhex("FFFFFD00 01 0800 55 00 A6000000 8CC0")
STATUS_OF_2_AT_2079 = bytes.fromhex("FFFFFD00 02 0800 55 00 1F080000 BABE")
SYNC_READ_1_2 = bytes.fromhex("FFFFFD00 FE 0900 82 84000400 0102 CEFA")

# In real time. No test waits for the ample one; where a time-out is to happen, it is short.
AMPLE_S = 5.0
SHORT_S = 0.02


@contextlib.contextmanager
def emulated(
    position: Callable[[int], int] = lambda _: 0,
    baudrate: int = 1_000_000,
    timeout_s: float = AMPLE_S,
    asked_id: int = 1,
) -> Iterator[tuple[EmulatedServo, Dynamixel, VirtualClock]]:
    clock = VirtualClock(t_ns=1_000_000_000)
    with EmulatedServo(position, clock, baudrate=baudrate) as servo:
        driver = open_servo(
            servo.port, baudrate=baudrate, clock=clock, servo_id=asked_id, timeout_s=timeout_s
        )
        with contextlib.closing(driver):
            yield servo, driver, clock


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


def servo_on(port: ScriptedPort, clock: VirtualClock | None = None) -> Dynamixel:
    return Dynamixel(
        port, clock or VirtualClock(), servo_id=1, baudrate=1_000_000, timeout_s=SHORT_S
    )


def status(*parameters: int, servo_id: int = 1) -> bytes:
    return instruction_packet(servo_id, Instruction.STATUS, bytes(parameters))


# Packets


def test_the_crc_is_the_one_of_the_manual() -> None:
    assert crc16(b"123456789") == 0xFEE8
    assert crc16(b"") == 0


@pytest.mark.parametrize(
    ("packet", "golden"),
    [
        (instruction_packet(1, Instruction.PING), PING_1),
        (read_packet(1, 132, 4), READ_POSITION_OF_1),
        (status(0, 0xA6, 0, 0, 0), STATUS_OF_1_AT_166),
        (status(0, 0x1F, 0x08, 0, 0, servo_id=2), STATUS_OF_2_AT_2079),
        (
            instruction_packet(0xFE, Instruction.SYNC_READ, bytes([132, 0, 4, 0, 1, 2])),
            SYNC_READ_1_2,
        ),
    ],
    ids=["ping", "read", "status of 1", "status of 2", "sync read"],
)
def test_the_golden_packets_are_reproduced_byte_for_byte(packet: bytes, golden: bytes) -> None:
    assert packet == golden


def test_a_golden_status_is_decoded() -> None:
    packets = PacketDecoder().feed(STATUS_OF_2_AT_2079)
    assert packets == [Packet(2, 0x55, bytes([0, 0x1F, 0x08, 0, 0]), crc_ok=True, wire_bytes=15)]


def test_a_header_within_the_parameters_is_stuffed_and_counted_in_the_length() -> None:
    packet = instruction_packet(1, 0x55, bytes.fromhex("00 FFFFFD00"))
    assert packet[:-2] == bytes.fromhex("FFFFFD00 01 0900 55 00 FFFFFDFD00")
    assert crc16(packet[:-2]) == int.from_bytes(packet[-2:], "little")


# Bytes of which headers, stuffing and their near misses are made come up often.
awkward = st.lists(
    st.sampled_from([b"\xff", b"\xfd", b"\x00", b"\xff\xff\xfd", b"\xff\xff\xfd\x00", b"\x55"])
    | st.binary(min_size=1, max_size=3),
    max_size=20,
).map(b"".join)
# Noise that holds a whole header is another matter: its length is believed until the CRC is wrong.
noise = awkward.filter(lambda data: b"\xff\xff\xfd\x00" not in data)


@given(
    parameters=awkward,
    garbage=noise,
    servo_id=st.integers(0, 252),
    instruction=st.integers(0, 255),
    cuts=st.lists(st.integers(0, 200)),
)
def test_any_packet_survives_stuffing_garbage_in_front_and_any_cuts(
    parameters: bytes, garbage: bytes, servo_id: int, instruction: int, cuts: list[int]
) -> None:
    packet = instruction_packet(servo_id, instruction, parameters)
    stream = garbage + packet
    edges = sorted({0, len(stream), *(cut for cut in cuts if cut < len(stream))})
    decoder = PacketDecoder()
    found = []
    for begin, end in itertools.pairwise(edges):
        found += decoder.feed(stream[begin:end])
    assert found == [Packet(servo_id, instruction, parameters, True, len(packet))]


@given(parameters=awkward, garbage=noise)
def test_asking_for_what_is_missing_never_asks_beyond_the_packet(
    parameters: bytes, garbage: bytes
) -> None:
    stream = garbage + instruction_packet(1, 0x55, parameters)
    decoder, found, at = PacketDecoder(), list[Packet](), 0
    while not found:
        assert 0 < decoder.missing <= len(stream) - at
        n = decoder.missing
        found = decoder.feed(stream[at : at + n])
        at += n
    assert at == len(stream)


@given(noise=st.binary(max_size=600))
def test_no_noise_breaks_the_decoder(noise: bytes) -> None:
    decoder = PacketDecoder()
    decoder.feed(noise)
    assert decoder.missing > 0


def test_a_header_made_by_noise_does_not_swallow_the_packet_behind_it() -> None:
    false_start = bytes.fromhex("FFFFFD00 01 0F00 55")
    found = PacketDecoder().feed(false_start + STATUS_OF_1_AT_166)
    assert [packet.crc_ok for packet in found] == [False, True]
    impossible_length = bytes.fromhex("FFFFFD00 01 FFFF")
    (packet,) = PacketDecoder().feed(impossible_length + STATUS_OF_1_AT_166)
    assert packet.crc_ok


def test_two_packets_in_one_piece_are_two_packets() -> None:
    found = PacketDecoder().feed(STATUS_OF_1_AT_166 + STATUS_OF_2_AT_2079)
    assert [packet.servo_id for packet in found] == [1, 2]


# The driver against scripted bytes


def test_the_driver_sends_the_golden_requests() -> None:
    port = ScriptedPort(STATUS_OF_1_AT_166)
    assert servo_on(port).read_position().counts == 166
    assert port.written == READ_POSITION_OF_1
    port = ScriptedPort(status(0, 55, 1, 42))
    assert servo_on(port).ping() == MODELS["MX-64"].number == 311
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
    with pytest.raises(ServoPacketError, match="parameters; expected 5"):
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
    assert (reading.counts, reading.alert) == (-5, True)


def test_silence_is_a_timeout_that_says_what_to_check_and_takes_its_time() -> None:
    clock = VirtualClock(7)
    with pytest.raises(ServoTimeoutError, match="no answer within 20 ms") as caught:
        servo_on(ScriptedPort(b""), clock).ping()
    for thing in ("power", "its id", "baud rate", "latency timer"):
        assert thing in str(caught.value)
    assert clock.now_ns() == 7 + 20_000_000
    assert isinstance(caught.value, TimeoutError)
    assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)  # noqa: S301


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


def test_wire_time_is_ten_bits_to_the_byte() -> None:
    assert wire_time_ns(15, 1_000_000) == 150_000
    assert wire_time_ns(14, 57_600) == 2_430_555


# The driver against an emulated servo


@pytest.mark.parametrize("counts", [0, 166, -5, 4095, 4096, 2**31 - 1, -(2**31), 0x00FDFFFF])
def test_positions_are_signed_and_may_need_stuffing(counts: int) -> None:
    with emulated(lambda _: counts) as (_, driver, _):
        assert driver.ping() == 311
        reading = driver.read_position()
        assert (reading.counts, reading.half_width_ns) == (counts, 250_000)


@pytest.mark.parametrize(
    ("baudrate", "request_ns", "answer_ns"),
    [(1_000_000, 140_000, 150_000), (57_600, 2_430_555, 2_604_166)],
)
def test_the_time_stamp_is_midway_between_request_and_answer(
    baudrate: int, request_ns: int, answer_ns: int
) -> None:
    def run() -> list[tuple[int, int, int, int]]:
        sampled: list[int] = []

        def position(t_ns: int) -> int:
            sampled.append(t_ns)
            return t_ns % 5000 - 2500

        stamps = []
        with emulated(position, baudrate) as (_, driver, clock):
            for _ in range(5):
                t_ns = clock.now_ns()
                reading = driver.read_position()
                sample_ns = sampled[-1] - t_ns
                stamps.append(
                    (
                        sample_ns,
                        reading.t_mono_ns - t_ns,
                        reading.half_width_ns,
                        reading.done_ns - t_ns,
                    )
                )
                assert reading.counts == position(t_ns + sample_ns)
                assert reading.done_ns == clock.now_ns()
        return stamps

    exchange_ns = request_ns + 500_000 + answer_ns
    expected = (request_ns + 500_000, request_ns + 250_000, 250_000, exchange_ns)
    assert run() == run() == [expected] * 5
    # hardware.md 5.2, P2 (14 + 15 bytes)
    assert f"{exchange_ns / 1e6:.2f}" == {1_000_000: "0.79", 57_600: "5.53"}[baudrate]


def test_on_a_system_clock_an_answer_takes_the_time_of_the_wire() -> None:
    clock = SystemClock()
    with EmulatedServo(lambda _: 7, clock, baudrate=57_600) as servo:
        driver = open_servo(servo.port, baudrate=57_600, clock=clock, timeout_s=AMPLE_S)
        with contextlib.closing(driver):
            t_ns = clock.now_ns()
            reading = driver.read_position()
    assert reading.done_ns - t_ns >= 5_534_721
    assert reading.half_width_ns >= 250_000


def test_garbage_before_an_answer_does_no_more_than_widen_the_interval() -> None:
    with (
        emulated(lambda _: -5) as (servo, driver, _),
        servo.garbage_before_reply(b"\x00\xff\xff\xfd\xff"),
    ):
        reading = driver.read_position()
        assert reading.counts == -5
        assert reading.half_width_ns == 250_000 + 25_000


def test_a_corrupted_answer_is_refused_at_once() -> None:
    with emulated() as (servo, driver, clock):
        t_ns = clock.now_ns()
        with servo.corrupt_crc(), pytest.raises(ServoPacketError, match="CRC"):
            driver.read_position()
        assert clock.now_ns() - t_ns < 1_000_000
        assert driver.read_position().counts == 0


def test_a_silent_servo_times_out_and_is_well_again_afterwards() -> None:
    with emulated(timeout_s=SHORT_S) as (servo, driver, clock):
        t_ns = clock.now_ns()
        with servo.silent(), pytest.raises(ServoTimeoutError):
            driver.read_position()
        assert clock.now_ns() == t_ns + 20_000_000
    with emulated() as (servo, driver, _):
        with servo.silent():
            pass
        assert driver.ping() == 311


def test_a_servo_of_another_id_is_silent() -> None:
    with (
        emulated(timeout_s=SHORT_S, asked_id=2) as (_, driver, _),
        pytest.raises(ServoTimeoutError, match="servo 2 at 1000000 baud"),
    ):
        driver.ping()


def test_a_servo_at_another_baud_rate_is_silent() -> None:
    clock = VirtualClock()
    with EmulatedServo(lambda _: 0, clock, baudrate=57_600) as servo:
        driver = open_servo(servo.port, baudrate=1_000_000, clock=clock, timeout_s=SHORT_S)
        with contextlib.closing(driver), pytest.raises(ServoTimeoutError, match="baud rate"):
            driver.ping()


def test_an_alert_keeps_the_value() -> None:
    with emulated(lambda _: -5) as (servo, driver, _):
        with servo.alert():
            reading = driver.read_position()
            assert (reading.counts, reading.alert) == (-5, True)
            assert driver.ping() == 311
        assert not driver.read_position().alert


# The port


def test_a_port_that_is_not_there_is_a_setup_error_with_a_remedy() -> None:
    with pytest.raises(ServoSetupError, match="group dialout"):
        open_servo("/dev/no-such-port", baudrate=57_600, clock=VirtualClock())


@pytest.mark.parametrize(("port", "baudrate"), [("/dev/null", 57_600), (None, -1)])
def test_what_is_no_serial_port_or_no_baud_rate_is_a_setup_error(
    port: str | None, baudrate: int
) -> None:
    with (
        EmulatedServo(lambda _: 0, VirtualClock()) as servo,
        pytest.raises(ServoSetupError, match="cannot be opened"),
    ):
        open_servo(port or servo.port, baudrate=baudrate, clock=VirtualClock())


def test_a_port_has_one_user() -> None:
    with emulated() as (servo, _, clock), pytest.raises(ServoSetupError, match="cannot be opened"):
        open_servo(servo.port, baudrate=1_000_000, clock=clock)


def test_a_plug_that_is_pulled_is_a_setup_error() -> None:
    with emulated() as (servo, driver, _):
        assert driver.ping() == 311
        servo.close()
        with pytest.raises(ServoSetupError, match="serial port failed"):
            driver.read_position()
