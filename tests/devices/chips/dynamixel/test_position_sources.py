"""The servo in lock-step with virtual time: nothing is known before its answer is complete."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.chips.dynamixel.driver import PositionReading, open_servo
from devices.chips.dynamixel.position_sources import ThreadedServoSource, VirtualTimeServoSource
from devices.chips.dynamixel.protocol import Instruction, Packet
from devices.clock import SystemClock, VirtualClock
from devices.emulation.chips.dynamixel import EmulatedServo
from devices.emulation.fault_timing import FaultTiming
from devices.errors import (
    ServoError,
    ServoLostError,
    ServoPacketError,
    ServoStatusError,
    ServoTimeoutError,
)
from tests.builders.servo import FaultyServo
from tests.devices.chips.dynamixel.lines import AMPLE_S, both_protocols
from tests.waiting import until

MS = 1_000_000
ANSWER_NS = 600_000


class Scripted:
    """A servo whose n-th reading is n, takes 0.6 ms, and is true in the middle of it."""

    def __init__(self, clock: VirtualClock) -> None:
        self.clock = clock
        self.asked_ns: list[int] = []
        self.error: Exception | None = None
        self.answer_ns = ANSWER_NS

    def read_position(self) -> PositionReading:
        begin_ns = self.clock.now_ns()
        self.asked_ns.append(begin_ns)
        self.clock.sleep_until_ns(begin_ns + self.answer_ns)
        if self.error is not None:
            raise self.error
        return PositionReading(
            counts=len(self.asked_ns),
            t_mono_ns=begin_ns + self.answer_ns // 2,
            half_width_ns=self.answer_ns // 2,
            answered_ns=begin_ns + self.answer_ns,
        )


def polled(rate_hz: float = 100.0, start_ns: int = 0) -> tuple[VirtualTimeServoSource, Scripted]:
    clock = VirtualClock(start_ns)
    servo: Any = Scripted(clock)
    return VirtualTimeServoSource(servo, clock, rate_hz=rate_hz), servo


def test_a_position_is_known_only_from_the_end_of_its_answer_on() -> None:
    source, _ = polled(start_ns=5 * MS)
    assert source.find_latest_position(5 * MS - 1) is None
    assert source.find_latest_position(5 * MS) is None
    assert source.find_latest_position(5 * MS + ANSWER_NS - 1) is None
    assert source.find_latest_position(5 * MS + ANSWER_NS) == (1, 5 * MS + ANSWER_NS // 2)


def test_the_position_before_is_given_until_the_next_one_is_complete() -> None:
    source, _ = polled()
    assert source.find_latest_position(10 * MS + ANSWER_NS - 1) == (1, ANSWER_NS // 2)
    assert source.find_latest_position(10 * MS + ANSWER_NS) == (2, 10 * MS + ANSWER_NS // 2)


def test_the_servo_is_asked_at_its_own_rate_however_often_frames_ask() -> None:
    often, often_servo = polled(rate_hz=100.0)
    for t_ns in range(0, 100 * MS, MS // 3):
        often.find_latest_position(t_ns)
    seldom, seldom_servo = polled(rate_hz=100.0)
    seldom.find_latest_position(100 * MS - 1)
    expected = [10 * MS * i for i in range(10)]
    assert often_servo.asked_ns == seldom_servo.asked_ns == expected


@given(steps=st.lists(st.integers(1, 40 * MS), min_size=1, max_size=40))
def test_what_a_frame_sees_does_not_depend_on_who_asked_before(steps: list[int]) -> None:
    source, _ = polled()
    t_ns = 0
    for step in steps:
        t_ns += step
        seen = source.find_latest_position(t_ns)
        complete = (t_ns - ANSWER_NS) // (10 * MS)  # number of the newest complete answer
        if complete < 0:
            assert seen is None
        else:
            assert seen == (complete + 1, complete * 10 * MS + ANSWER_NS // 2)


def test_a_servo_slower_than_its_rate_is_asked_again_as_soon_as_it_is_done() -> None:
    source, servo = polled(rate_hz=1000.0)
    servo.answer_ns = 1_700_000
    source.find_latest_position(5 * MS)
    assert servo.asked_ns == [0, 1_700_000, 3_400_000]


@pytest.mark.parametrize("rate_hz", [50.0, 100.0, 1000.0])
def test_a_position_is_stale_after_three_intervals(rate_hz: float) -> None:
    assert polled(rate_hz=rate_hz)[0].stale_after_ns == round(3e9 / rate_hz)


@pytest.mark.parametrize("kind", [ServoTimeoutError, ServoPacketError, ServoStatusError])
def test_a_reading_that_fails_is_counted_and_the_last_position_grows_old(
    kind: type[ServoError],
) -> None:
    source, servo = polled()
    assert source.find_latest_position(MS) == (1, ANSWER_NS // 2)
    servo.error = kind("no answer")
    assert source.find_latest_position(35 * MS) == (1, ANSWER_NS // 2)
    assert source.failed_readings == 3
    servo.error = None
    assert source.find_latest_position(45 * MS) == (5, 40 * MS + ANSWER_NS // 2)
    assert source.failed_readings == 3


def test_what_is_no_error_of_the_servo_is_raised() -> None:
    source, servo = polled()
    servo.error = ZeroDivisionError("a bug")
    with pytest.raises(ZeroDivisionError):
        source.find_latest_position(0)


def test_a_servo_that_never_answers_has_no_position() -> None:
    source, servo = polled()
    servo.error = ServoTimeoutError("no answer")
    assert source.find_latest_position(95 * MS) is None
    assert source.failed_readings == 10


@contextlib.contextmanager
def emulated(
    position: Callable[[int], int], asked_id: int = 1, timeout_s: float = 5.0
) -> Iterator[tuple[VirtualTimeServoSource, VirtualClock]]:
    line_clock = VirtualClock(1_000 * MS)
    with EmulatedServo(position, line_clock) as servo:
        driver = open_servo(
            servo.port,
            baudrate=1_000_000,
            clock=line_clock,
            servo_id=asked_id,
            timeout_s=timeout_s,
        )
        with contextlib.closing(driver):
            yield VirtualTimeServoSource(driver, line_clock, rate_hz=200.0), line_clock


def test_an_emulated_servo_is_read_over_its_line_and_ages_right() -> None:
    with emulated(lambda t_ns: t_ns // 1000 % 100_000) as (source, _):
        for t_ns in (1_010 * MS, 1_013 * MS, 1_050 * MS):
            seen = source.find_latest_position(t_ns)
            assert seen is not None
            counts, sampled_ns = seen
            # The position of this servo is the time in us; 200 Hz, and an answer of 0.8 ms.
            assert 0 < t_ns - sampled_ns < 6 * MS
            assert counts == pytest.approx(sampled_ns // 1000 % 100_000, abs=260)
        assert source.failed_readings == 0


def test_a_servo_of_another_id_is_counted_as_failing() -> None:
    with emulated(lambda _: 0, asked_id=2, timeout_s=0.01) as (source, line_clock):
        opened_ns = line_clock.now_ns()
        assert source.find_latest_position(opened_ns) is None
        assert source.failed_readings == 1
        assert line_clock.now_ns() >= opened_ns + 10 * MS, (
            "the time-out passes on the virtual clock"
        )


# A servo that goes away, and one that restarts

MULTI_TURN = {1: (6, b"\xff\x0f\xff\x0f"), 2: (11, b"\x04")}
"""Register and value that make a servo count turns (e-manual mx-64.md, mx-64-2.md)."""


@contextlib.contextmanager
def faulty(
    position: Callable[[int], int],
    *,
    protocol: int = 2,
    unplugged: FaultTiming | None = None,
    unpowered: FaultTiming | None = None,
    mode: tuple[int, bytes] | None = None,
) -> Iterator[VirtualTimeServoSource]:
    clock = VirtualClock(1_000 * MS)
    for fault in (unplugged, unpowered):
        if fault is not None:
            fault.begin_scene_time(clock.now_ns())
    with FaultyServo(
        position, clock, protocol=protocol, unplugged=unplugged, unpowered=unpowered
    ) as servo:
        servo.write_table(*(mode or MULTI_TURN[protocol]))
        driver = open_servo(
            lambda: servo.port,
            baudrate=1_000_000,
            clock=clock,
            timeout_s=AMPLE_S if unpowered is None else 0.25,
            protocol=protocol,
        )
        with contextlib.closing(driver):
            yield VirtualTimeServoSource(driver, clock, rate_hz=100.0)


def seen_each_100_ms(source: VirtualTimeServoSource, end_s: float) -> dict[int, int | None]:
    """Position at each tenth of a second after the beginning; None where it is not known."""
    found: dict[int, int | None] = {}
    for tenth in range(1, round(10 * end_s)):
        t_ns = (1_000 + 100 * tenth) * MS
        position = source.find_latest_position(t_ns)
        fresh = position is not None and t_ns - position[1] <= source.stale_after_ns
        found[tenth] = position[0] if position and fresh and source.is_turn_known else None
    return found


@both_protocols
@pytest.mark.parametrize("away_s", [0.05, 0.7, 3.0])
def test_an_adapter_that_was_unplugged_is_opened_again_and_the_turn_is_kept(
    protocol: int, away_s: float
) -> None:
    with faulty(
        lambda _: 9000, protocol=protocol, unplugged=FaultTiming([(1.0, 1.0 + away_s)])
    ) as source:
        assert set(seen_each_100_ms(source, 1.0).values()) == {9000}
        assert source.find_latest_position(2_050 * MS) is None, (
            "what was read before tells nothing now"
        )
        assert "serial port" in source.warning
        seen = seen_each_100_ms(source, 8.0)
        assert seen[79] == 9000
        assert source.warning == ""


@both_protocols
def test_a_restart_beyond_its_turn_leaves_no_angle_and_is_said(protocol: int) -> None:
    with faulty(lambda _: 9000, protocol=protocol, unpowered=FaultTiming([(1.0, 1.5)])) as source:
        seen = seen_each_100_ms(source, 4.0)
        assert {seen[tenth] for tenth in range(1, 10)} == {9000}
        assert {seen[tenth] for tenth in range(11, 40)} == {None}
        assert (source.find_latest_position(5_000 * MS) or (None,))[0] == 9000 % 4096, (
            "kept as it was read"
        )
        assert "turn" in source.warning


@both_protocols
def test_a_restart_of_a_joint_that_stays_in_its_turn_costs_the_silence_only(protocol: int) -> None:
    mode = {1: (6, b"\x00\x00\xff\x0f"), 2: (11, b"\x03")}[protocol]
    with faulty(
        lambda _: 3000, protocol=protocol, unpowered=FaultTiming([(1.0, 1.5)]), mode=mode
    ) as source:
        seen = seen_each_100_ms(source, 4.0)
    assert {seen[tenth] for tenth in range(11, 15)} == {None}
    assert {seen[tenth] for tenth in range(20, 40)} == {3000}


def test_a_wheel_in_protocol_1_goes_on_beyond_its_turn() -> None:
    def position(t_ns: int) -> int:
        return (t_ns - 1_000 * MS) // (MS // 2)  # half a turn a second

    with faulty(position, protocol=1, mode=(6, bytes(4))) as source:
        seen = seen_each_100_ms(source, 6.0)
    assert seen[59] == pytest.approx(2 * 5_900, abs=40)


class PositionOnly(FaultyServo):
    """A servo that answers its position, its identity, and nothing else."""

    def _answer(self, packet: Packet, received_ns: int) -> None:
        if packet.instruction == Instruction.PING or packet.parameters[0] == 132:
            super()._answer(packet, received_ns)


def test_a_servo_without_registers_is_read_all_the_same() -> None:
    clock = VirtualClock(1_000 * MS)
    with PositionOnly(lambda _: 9000, clock) as servo:
        driver = open_servo(servo.port, baudrate=1_000_000, clock=clock, timeout_s=0.25)
        with contextlib.closing(driver):
            source = VirtualTimeServoSource(driver, clock, rate_hz=100.0)
            assert seen_each_100_ms(source, 4.0)[39] == 9000
            with servo.silent():
                source.find_latest_position(6_000 * MS)
            source.find_latest_position(6_500 * MS)
            assert not source.is_turn_known, "it may have restarted"


def test_another_servo_in_its_place_is_not_read() -> None:
    clock = VirtualClock(1_000 * MS)
    with (
        FaultyServo(lambda _: 5, clock) as right,
        FaultyServo(lambda _: 7, clock, model="MX-28") as wrong,
    ):
        here = [right.port]
        driver = open_servo(lambda: here[0], baudrate=1_000_000, clock=clock, timeout_s=AMPLE_S)
        with contextlib.closing(driver):
            source = VirtualTimeServoSource(driver, clock, rate_hz=100.0)
            assert source.find_latest_position(1_050 * MS) is not None
            here[0] = wrong.port
            right.close()
            assert source.find_latest_position(4_000 * MS) is None
            assert "MX-28" in source.warning


def test_a_port_that_is_not_there_yet_is_waited_for_if_that_is_asked(tmp_path: Path) -> None:
    clock, path = VirtualClock(1_000 * MS), tmp_path / "ttyUSB0"
    with pytest.raises(ServoLostError):
        open_servo(str(path), baudrate=1_000_000, clock=clock)
    driver = open_servo(
        str(path), baudrate=1_000_000, clock=clock, timeout_s=AMPLE_S, allows_missing_port=True
    )
    assert "not there yet" in driver.opening_warnings[0]
    source = VirtualTimeServoSource(driver, clock, rate_hz=100.0)
    assert source.find_latest_position(1_500 * MS) is None
    with FaultyServo(lambda _: 77, clock) as servo:
        path.symlink_to(servo.port)
        with contextlib.closing(driver):
            assert (source.find_latest_position(2_600 * MS) or (None,))[0] == 77


# On a real clock


def test_a_thread_opens_a_port_again_that_hung_up() -> None:
    clock = SystemClock()
    pulled = FaultTiming()
    with FaultyServo(lambda _: 11, clock, unplugged=pulled) as servo:
        driver = open_servo(lambda: servo.port, baudrate=1_000_000, clock=clock)
        with (
            contextlib.closing(driver),
            ThreadedServoSource(driver, clock, rate_hz=200.0) as source,
        ):
            until(lambda: source.find_latest_position(clock.now_ns()))
            with pulled.inject():
                until(lambda: source.find_latest_position(clock.now_ns()) is None)
                assert "serial port" in source.warning
            until(lambda: source.find_latest_position(clock.now_ns()))
            until(lambda: source.warning == "")


def soon(true: Callable[[], bool]) -> bool:
    end = time.monotonic() + 10.0
    while not true() and time.monotonic() < end:
        time.sleep(0.001)
    return true()


class Counting:
    """A servo whose n-th reading is n; it fails or hangs when it is told to."""

    def __init__(self) -> None:
        self.readings = 0
        self.error: ServoError | None = None
        self.hangs = threading.Event()
        self.goes_on = threading.Event()

    def read_position(self) -> PositionReading:
        if self.hangs.is_set():
            self.goes_on.wait(10.0)
        if self.error is not None:
            raise self.error
        self.readings += 1
        now_ns = time.monotonic_ns()
        return PositionReading(self.readings, now_ns, 0, now_ns)


def test_a_reader_on_a_real_clock_has_ever_newer_positions() -> None:
    servo: Any = Counting()
    with ThreadedServoSource(servo, SystemClock(), rate_hz=500.0) as source:
        assert soon(lambda: source.find_latest_position(time.monotonic_ns()) is not None)
        first = source.find_latest_position(time.monotonic_ns())
        assert first is not None
        assert soon(
            lambda: (source.find_latest_position(time.monotonic_ns()) or (0, 0))[0] > first[0] + 5
        )
        newest = source.find_latest_position(time.monotonic_ns())
        assert newest is not None
        assert newest[1] > first[1]
    assert "servo" not in {thread.name for thread in threading.enumerate()}


def test_a_position_sampled_while_the_frame_was_taken_has_no_negative_age() -> None:
    servo: Any = Counting()
    with ThreadedServoSource(servo, SystemClock(), rate_hz=500.0) as source:
        assert soon(lambda: source.find_latest_position(time.monotonic_ns()) is not None)
        reading = source.find_latest_position(0)
    assert reading is not None
    assert reading[1] == 0


def test_a_frame_gets_the_position_of_its_own_instant_though_newer_ones_have_come() -> None:
    servo: Any = Counting()
    with ThreadedServoSource(servo, SystemClock(), rate_hz=500.0) as source:
        assert soon(lambda: servo.readings > 3)
        t_mono_ns = time.monotonic_ns()
        at_once = source.find_latest_position(t_mono_ns)
        readings = servo.readings
        assert soon(lambda: servo.readings > readings + 3)
        later = source.find_latest_position(t_mono_ns)
    assert at_once is not None
    assert later is not None
    assert later[1] <= t_mono_ns
    assert 0 <= later[0] - at_once[0] <= 1, "one more may have been on its way"


def test_a_hanging_servo_costs_the_frames_nothing_and_grows_old() -> None:
    servo: Any = Counting()
    with ThreadedServoSource(servo, SystemClock(), rate_hz=500.0) as source:
        assert soon(lambda: servo.readings > 3)
        servo.hangs.set()
        begin_s = time.monotonic()
        assert soon(
            lambda: (
                time.monotonic_ns()
                - (source.find_latest_position(time.monotonic_ns()) or (0, 0))[1]
                > source.stale_after_ns
            )
        )
        for _ in range(1000):
            source.find_latest_position(time.monotonic_ns())
        assert time.monotonic() - begin_s < 5.0
        servo.hangs.clear()
        servo.goes_on.set()


def test_failed_readings_are_counted_and_it_goes_on_when_the_servo_does() -> None:
    servo: Any = Counting()
    servo.error = ServoTimeoutError("no answer")
    with ThreadedServoSource(servo, SystemClock(), rate_hz=500.0) as source:
        assert soon(lambda: source.failed_readings > 2)
        assert source.find_latest_position(time.monotonic_ns()) is None
        servo.error = None
        assert soon(lambda: source.find_latest_position(time.monotonic_ns()) is not None)
