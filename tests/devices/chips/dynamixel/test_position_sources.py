"""Sources of servo positions: in virtual time and in a thread, over faults of servo and line."""

from __future__ import annotations

import contextlib
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from devices.acquisition import ServoSource
from devices.chips.dynamixel.driver import PositionReading
from devices.chips.dynamixel.position_sources import (
    ThreadedServoSource,
    TurnUnwrapper,
    VirtualTimeServoSource,
)
from devices.chips.dynamixel.protocol import CountRange, Instruction, Packet
from devices.chips.dynamixel.servo_setup import open_servo
from devices.clock import SystemClock, VirtualClock
from devices.emulation.fault_timing import FaultTiming
from devices.errors import (
    ServoError,
    ServoLostError,
    ServoPacketError,
    ServoStatusError,
    ServoTimeoutError,
)
from tests.builders.servo import FaultyServo
from tests.devices.chips.dynamixel.lines import AMPLE_S, both_protocols, emulated
from tests.waiting import until

MS = 1_000_000
ANSWER_NS = 600_000


class ScriptedServo:
    """A servo with n as its n-th reading, which takes 0.6 ms and is sampled in the middle."""

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


def find_position(source: ServoSource, t_mono_ns: int) -> tuple[int, int]:
    """Return counts and instant of the latest position, which must be there."""
    position = source.find_latest_position(t_mono_ns)
    assert position is not None
    return position


def polled(
    rate_hz: float = 100.0, start_ns: int = 0
) -> tuple[VirtualTimeServoSource, ScriptedServo]:
    clock = VirtualClock(start_ns)
    servo: Any = ScriptedServo(clock)
    return VirtualTimeServoSource(servo, clock, rate_hz=rate_hz), servo


@given(
    steps_ns=st.lists(st.integers(1, 40 * MS), min_size=1, max_size=40),
    start_ns=st.sampled_from([0, 5 * MS]),
)
@example([ANSWER_NS - 1, 1], 5 * MS)
@example([10 * MS + ANSWER_NS - 1, 1], 0)
@example([100 * MS - 1], 0)
@example([MS // 3] * 300, 0)
def test_a_position_is_known_from_the_end_of_its_answer_on_however_often_frames_ask(
    steps_ns: list[int], start_ns: int
) -> None:
    source, servo = polled(start_ns=start_ns)
    assert source.find_latest_position(start_ns - 1) is None
    t_ns = start_ns
    for step_ns in steps_ns:
        t_ns += step_ns
        seen = source.find_latest_position(t_ns)
        newest = (t_ns - start_ns - ANSWER_NS) // (10 * MS)  # number of the newest answer
        sampled_ns = start_ns + newest * 10 * MS + ANSWER_NS // 2
        assert seen == (None if newest < 0 else (newest + 1, sampled_ns))
    assert servo.asked_ns == list(range(start_ns, t_ns + 1, 10 * MS))


def test_a_servo_slower_than_its_rate_is_read_again_at_once() -> None:
    source, servo = polled(rate_hz=1000.0)
    servo.answer_ns = 1_700_000
    source.find_latest_position(5 * MS)
    assert servo.asked_ns == [0, 1_700_000, 3_400_000]


@pytest.mark.parametrize("rate_hz", [50.0, 100.0, 1000.0])
def test_a_position_is_stale_after_three_intervals(rate_hz: float) -> None:
    assert polled(rate_hz=rate_hz)[0].stale_after_ns == round(3e9 / rate_hz)


@pytest.mark.parametrize("kind", [ServoTimeoutError, ServoPacketError, ServoStatusError])
def test_a_failed_reading_is_counted_and_the_last_position_ages(kind: type[ServoError]) -> None:
    source, servo = polled()
    assert source.find_latest_position(MS) == (1, ANSWER_NS // 2)
    servo.error = kind("no answer")
    assert source.find_latest_position(35 * MS) == (1, ANSWER_NS // 2)
    assert source.failed_readings == 3
    servo.error = None
    assert source.find_latest_position(45 * MS) == (5, 40 * MS + ANSWER_NS // 2)
    assert source.failed_readings == 3


def test_an_error_that_is_not_of_the_servo_is_raised() -> None:
    source, servo = polled()
    servo.error = ZeroDivisionError("a bug")
    with pytest.raises(ZeroDivisionError):
        source.find_latest_position(0)


# An emulated servo


def test_positions_of_an_emulated_servo_have_their_age() -> None:
    # The position of this servo is the time in us; 200 Hz, and an answer of 0.8 ms.
    with emulated(lambda t_ns: t_ns // 1000 % 100_000) as (_, driver, clock):
        source = VirtualTimeServoSource(driver, clock, rate_hz=200.0)
        for t_ns in (1_010 * MS, 1_013 * MS, 1_050 * MS):
            counts, sampled_ns = find_position(source, t_ns)
            assert 0 < t_ns - sampled_ns < 6 * MS
            assert counts == pytest.approx(sampled_ns // 1000 % 100_000, abs=260)
        assert source.failed_readings == 0


MULTI_TURN = {1: (6, b"\xff\x0f\xff\x0f"), 2: (11, b"\x04")}
"""Register and value of a servo that counts turns (e-manual mx-64.md, mx-64-2.md)."""
ONE_TURN = {1: (6, b"\x00\x00\xff\x0f"), 2: (11, b"\x03")}


def read_tenths(source: VirtualTimeServoSource, end_s: float) -> dict[int, int | None]:
    """Return the position at each tenth of a second; None where it is stale or unknown."""
    found: dict[int, int | None] = {}
    for tenth in range(1, round(10 * end_s)):
        t_ns = (1_000 + 100 * tenth) * MS
        position = source.find_latest_position(t_ns)
        is_fresh = position is not None and t_ns - position[1] <= source.stale_after_ns
        found[tenth] = position[0] if position and is_fresh and source.is_turn_known else None
    return found


@both_protocols
@pytest.mark.parametrize("away_s", [0.05, 3.0])
def test_an_unplugged_adapter_is_opened_again_and_the_turn_stays_known(
    protocol: int, away_s: float
) -> None:
    line = emulated(
        lambda _: 9000,
        protocol=protocol,
        unplugged=FaultTiming([(1.0, 1.0 + away_s)]),
        table=MULTI_TURN[protocol],
    )
    with line as (_, driver, clock):
        source = VirtualTimeServoSource(driver, clock, rate_hz=100.0)
        assert set(read_tenths(source, 1.0).values()) == {9000}
        assert source.find_latest_position(2_050 * MS) is None
        assert "serial port" in source.warning
        assert read_tenths(source, 8.0)[79] == 9000
        assert source.warning == ""


@both_protocols
@pytest.mark.parametrize("is_multi_turn", [True, False])
def test_the_turn_is_unknown_after_a_restart_unless_the_joint_has_one_turn(
    protocol: int, is_multi_turn: bool
) -> None:
    counts = 9000 if is_multi_turn else 3000
    line = emulated(
        lambda _: counts,
        protocol=protocol,
        unpowered=FaultTiming([(1.0, 1.5)]),
        table=(MULTI_TURN if is_multi_turn else ONE_TURN)[protocol],
        timeout_s=0.25,
    )
    with line as (_, driver, clock):
        source = VirtualTimeServoSource(driver, clock, rate_hz=100.0)
        seen = read_tenths(source, 4.0)
        assert {seen[tenth] for tenth in range(1, 10)} == {counts}
        assert {seen[tenth] for tenth in range(11, 15)} == {None}
        assert {seen[tenth] for tenth in range(20, 40)} == {None if is_multi_turn else counts}
        if is_multi_turn:
            assert {seen[tenth] for tenth in range(11, 40)} == {None}
            assert find_position(source, 5_000 * MS)[0] == 9000 % 4096, "counts are stored as read"
            assert "turn" in source.warning


def test_a_wheel_of_protocol_1_is_counted_beyond_its_turn() -> None:
    def position(t_ns: int) -> int:
        return (t_ns - 1_000 * MS) // (MS // 2)  # half a turn a second

    with emulated(position, protocol=1, table=(6, bytes(4))) as (_, driver, clock):
        seen = read_tenths(VirtualTimeServoSource(driver, clock, rate_hz=100.0), 6.0)
    assert seen[59] == pytest.approx(2 * 5_900, abs=40)


def test_a_servo_without_registers_is_read_and_a_silence_counts_as_a_restart(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    answer = FaultyServo._answer

    def answer_positions(self: FaultyServo, packet: Packet, received_ns: int) -> None:
        if packet.instruction == Instruction.PING or packet.parameters[0] == 132:
            answer(self, packet, received_ns)

    monkeypatch.setattr(FaultyServo, "_answer", answer_positions)
    with emulated(lambda _: 9000, timeout_s=0.25) as (servo, driver, clock):
        source = VirtualTimeServoSource(driver, clock, rate_hz=100.0)
        assert read_tenths(source, 4.0)[39] == 9000
        with servo.silent():
            source.find_latest_position(6_000 * MS)
        source.find_latest_position(6_500 * MS)
        assert not source.is_turn_known


def test_another_servo_at_the_same_port_is_not_read() -> None:
    clock = VirtualClock(1_000 * MS)
    with (
        FaultyServo(lambda _: 5, clock) as right,
        FaultyServo(lambda _: 7, clock, model="MX-28") as wrong,
    ):
        ports = [right.port]
        driver = open_servo(lambda: ports[0], baudrate=1_000_000, clock=clock, timeout_s=AMPLE_S)
        with contextlib.closing(driver):
            source = VirtualTimeServoSource(driver, clock, rate_hz=100.0)
            assert source.find_latest_position(1_050 * MS) is not None
            ports[0] = wrong.port
            right.close()
            assert source.find_latest_position(4_000 * MS) is None
            assert "MX-28" in source.warning


def test_a_missing_port_is_opened_later_if_the_caller_allows_it(tmp_path: Path) -> None:
    clock, path = VirtualClock(1_000 * MS), tmp_path / "ttyUSB0"
    with pytest.raises(ServoLostError):
        open_servo(str(path), baudrate=1_000_000, clock=clock)
    driver = open_servo(
        str(path), baudrate=1_000_000, clock=clock, timeout_s=AMPLE_S, allows_missing_port=True
    )
    assert "not there yet" in driver.opening_warnings[0]
    source = VirtualTimeServoSource(driver, clock, rate_hz=100.0)
    assert source.find_latest_position(1_500 * MS) is None
    with FaultyServo(lambda _: 77, clock) as servo, contextlib.closing(driver):
        path.symlink_to(servo.port)
        assert find_position(source, 2_600 * MS)[0] == 77


# A thread on the system clock


def test_a_thread_reopens_a_lost_port() -> None:
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


class CountingServo:
    """A servo with n as its n-th reading, which can fail and hang."""

    def __init__(self) -> None:
        self.readings = 0
        self.error: ServoError | None = None
        self.may_answer = threading.Event()
        self.may_answer.set()

    def read_position(self) -> PositionReading:
        self.may_answer.wait(10.0)
        if self.error is not None:
            raise self.error
        self.readings += 1
        now_ns = time.monotonic_ns()
        return PositionReading(self.readings, now_ns, 0, now_ns)


def test_a_thread_reads_ever_newer_positions_and_a_frame_gets_that_of_its_instant() -> None:
    servo: Any = CountingServo()
    with ThreadedServoSource(servo, SystemClock(), rate_hz=500.0) as source:
        until(lambda: servo.readings > 3)
        t_mono_ns = time.monotonic_ns()
        at_once = find_position(source, t_mono_ns)
        readings = servo.readings
        until(lambda: servo.readings > readings + 3)
        later = find_position(source, t_mono_ns)
        newest = find_position(source, time.monotonic_ns())
    assert later[1] <= t_mono_ns < newest[1]
    assert 0 <= later[0] - at_once[0] <= 1, "one reading may have been on its way"
    assert newest[0] > readings + 2
    assert "servo" not in {thread.name for thread in threading.enumerate()}


def test_a_frame_whose_bus_was_held_up_gets_no_position_of_a_later_instant() -> None:
    servo: Any = CountingServo()
    with ThreadedServoSource(servo, SystemClock(), rate_hz=500.0) as source:
        until(lambda: servo.readings > 1)
        source._stop.set()
        source._thread.join()
        recent = source._recent
        just_before_ns = recent[-1].t_mono_ns - source.stale_after_ns
        assert find_position(source, just_before_ns)[1] == just_before_ns, "no age is negative"
        assert source.find_latest_position(just_before_ns - 1) is None
        assert source.find_latest_position(0) is None


def test_a_hanging_servo_does_not_delay_frames_and_its_position_ages() -> None:
    servo: Any = CountingServo()
    with ThreadedServoSource(servo, SystemClock(), rate_hz=500.0) as source:
        until(lambda: servo.readings > 3)
        servo.may_answer.clear()
        begin_s = time.monotonic()

        def age_ns() -> int:
            now_ns = time.monotonic_ns()
            return now_ns - find_position(source, now_ns)[1]

        until(lambda: age_ns() > source.stale_after_ns)
        for _ in range(1000):
            source.find_latest_position(time.monotonic_ns())
        assert time.monotonic() - begin_s < 5.0
        servo.may_answer.set()


def test_a_thread_counts_failed_readings_and_reads_on() -> None:
    servo: Any = CountingServo()
    servo.error = ServoTimeoutError("no answer")
    with ThreadedServoSource(servo, SystemClock(), rate_hz=500.0) as source:
        until(lambda: source.failed_readings > 2)
        assert source.find_latest_position(time.monotonic_ns()) is None
        servo.error = None
        until(lambda: source.find_latest_position(time.monotonic_ns()) is not None)


# Whole turns of a count: continued or unknown, and never wrong

TURN = 4096


def reading(
    counts: int,
    t_ms: float,
    *,
    restarted: bool = False,
    count_range: CountRange = CountRange.MANY_TURNS,
) -> PositionReading:
    t_ns = round(t_ms * MS)
    return PositionReading(counts, t_ns, 0, t_ns, has_restarted=restarted, count_range=count_range)


@dataclass
class Step:
    """Time, movement and restart between two readings."""

    wait_ms: int
    speed: float
    """Share of the greatest speed of a joint, -1 to 1."""
    restarts: bool


steps = st.lists(
    st.builds(
        Step,
        wait_ms=st.sampled_from([1, 5, 10, 20, 100, 300, 2_000]),
        speed=st.floats(-1, 1),
        restarts=st.booleans(),
    ),
    max_size=30,
)


@given(count_range=st.sampled_from(CountRange), start=st.integers(0, TURN - 1), steps=steps)
def test_a_position_is_the_true_one_or_its_turn_is_unknown(
    count_range: CountRange, start: int, steps: list[Step]
) -> None:
    unwrapper, true, zero, t_ms = TurnUnwrapper(), start, 0, 0
    unwrapper.unwrap(reading(true, t_ms, count_range=count_range))
    for step in steps:
        t_ms += step.wait_ms
        true += round(step.speed * 2.9 * TURN * step.wait_ms * 1e-3)
        if count_range is CountRange.ONE_TURN:
            true = max(0, min(true, TURN - 1))
        if step.restarts:
            zero = true // TURN * TURN
        counts = true % TURN if count_range is CountRange.WRAPPED else true - zero
        found = unwrapper.unwrap(
            reading(counts, t_ms, restarted=step.restarts, count_range=count_range)
        )
        if found.is_turn_known:
            assert found.counts == true
        else:
            assert found.counts == counts, "as read"


@given(start=st.integers(0, TURN - 1), steps=steps)
def test_the_turn_of_a_servo_that_answers_quickly_is_known_after_every_restart(
    start: int, steps: list[Step]
) -> None:
    unwrapper, true, zero = TurnUnwrapper(), start, 0
    unwrapper.unwrap(reading(true, 0))
    for i, step in enumerate(steps, start=1):
        true += round(step.speed * 2.9 * TURN * 0.1)
        if step.restarts:
            zero = true // TURN * TURN
        found = unwrapper.unwrap(reading(true - zero, 100 * i, restarted=step.restarts))
        assert (found.is_turn_known, found.counts) == (True, true)


MANY, ONE = CountRange.MANY_TURNS, CountRange.ONE_TURN


@pytest.mark.parametrize(
    ("count_range", "first", "later", "expected"),
    # Counts, ms and restarts of later readings; None where the turn is unknown.
    [
        (MANY, 5000, [(904, 1000, True), (904, 1010, False), (904, 1020, False)], [None] * 3),
        (MANY, 5000, [(9000, 3000, False)], [9000]),
        # Torque switched on in position control: no restart, and the count begins again.
        *((MANY, 5000, [(5000 + n * TURN, 10, False)], [5000]) for n in (1, -1, 3)),
        (MANY, 1000, [(2000, 10, False), (2000, 20, False)], [None] * 2),
        (MANY, 2**31 - 10, [(-(2**31) + 10, 10, False)], [None]),
        (ONE, 1000, [(3000, 2000, True), (3001, 2010, False)], [None, 3001]),
        (ONE, 5000, [(904, 1000, False)], [None]),
    ],
    ids=[
        "a restart in a long silence",
        "a long silence without a restart",
        *("a leap by a turn", "a leap back by a turn", "a leap by three turns"),
        "a leap faster than any joint",
        "a count beyond the column",
        "a joint of one turn is known at its second answer",
        "torque may have been switched on in a silence",
    ],
)
def test_a_turn_is_known_only_where_it_is_certain(
    count_range: CountRange,
    first: int,
    later: list[tuple[int, int, bool]],
    expected: list[int | None],
) -> None:
    unwrapper = TurnUnwrapper()
    unwrapper.unwrap(reading(first, 0, count_range=count_range))
    for (counts, t_ms, restarted), position in zip(later, expected, strict=True):
        found = unwrapper.unwrap(
            reading(counts, t_ms, restarted=restarted, count_range=count_range)
        )
        assert found.is_turn_known == (position is not None)
        assert found.counts == (counts if position is None else position)
