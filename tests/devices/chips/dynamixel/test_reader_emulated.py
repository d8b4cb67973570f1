"""The driver against an emulated servo on a serial line."""

from __future__ import annotations

import contextlib

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from devices.chips.dynamixel.driver import open_servo
from devices.clock import SystemClock, VirtualClock
from devices.errors import ServoPacketError, ServoTimeoutError
from tests.builders.servo import FaultyServo
from tests.devices.chips.dynamixel.lines import AMPLE_S, SHORT_S, both_protocols, emulated

# The driver against an emulated servo


@pytest.mark.parametrize("counts", [0, 166, -5, 4095, 4096, 2**31 - 1, -(2**31), 0x00FDFFFF])
def test_positions_are_signed_and_may_need_stuffing(counts: int) -> None:
    with emulated(lambda _: counts) as (_, driver, _):
        reading = driver.read_position()
        assert (reading.counts, reading.half_width_ns) == (counts, 250_000)


@both_protocols
@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(positions=st.lists(st.integers(-28_672, 28_672), min_size=1, max_size=10))
def test_positions_below_zero_and_beyond_a_turn_pass_unharmed(
    protocol: int, positions: list[int]
) -> None:
    here = [0]
    with emulated(lambda _: here[0], protocol=protocol) as (_, driver, _):
        for counts in positions:
            here[0] = counts
            assert driver.read_position().counts == counts


@pytest.mark.parametrize(
    ("protocol", "baudrate", "request_ns", "answer_ns", "table_ms"),
    [
        (2, 1_000_000, 140_000, 150_000, "0.79"),
        (2, 57_600, 2_430_555, 2_604_166, "5.53"),
        (1, 1_000_000, 80_000, 90_000, "0.67"),  # a byte more than the table's 8 + 8
        (1, 57_600, 1_388_888, 1_562_500, "3.45"),
    ],
)
def test_the_time_stamp_is_midway_between_request_and_answer(
    protocol: int, baudrate: int, request_ns: int, answer_ns: int, table_ms: str
) -> None:
    def run() -> list[tuple[int, int, int, int]]:
        sampled: list[int] = []

        def position(t_ns: int) -> int:
            sampled.append(t_ns)
            return t_ns % 5000 - 2500

        stamps = []
        with emulated(position, baudrate, protocol=protocol) as (_, driver, clock):
            for _ in range(5):
                t_ns = clock.now_ns()
                reading = driver.read_position()
                sample_ns = sampled[-1] - t_ns
                stamps.append(
                    (
                        sample_ns,
                        reading.t_mono_ns - t_ns,
                        reading.half_width_ns,
                        reading.answered_ns - t_ns,
                    )
                )
                assert reading.counts == position(t_ns + sample_ns)
                assert reading.answered_ns == clock.now_ns()
        return stamps

    exchange_ns = request_ns + 500_000 + answer_ns
    expected = (request_ns + 500_000, request_ns + 250_000, 250_000, exchange_ns)
    assert run() == run() == [expected] * 5
    assert f"{exchange_ns / 1e6:.2f}" == table_ms  # hardware.md 5.2


def test_on_a_system_clock_an_answer_takes_the_time_of_the_wire() -> None:
    clock = SystemClock()
    with FaultyServo(lambda _: 7, clock, baudrate=57_600) as servo:
        driver = open_servo(servo.port, baudrate=57_600, clock=clock, timeout_s=AMPLE_S)
        with contextlib.closing(driver):
            t_ns = clock.now_ns()
            reading = driver.read_position()
    assert reading.answered_ns - t_ns >= 5_534_721
    assert reading.half_width_ns >= 250_000


@both_protocols
def test_garbage_before_an_answer_does_no_more_than_widen_the_interval(protocol: int) -> None:
    with (
        emulated(lambda _: -5, protocol=protocol) as (servo, driver, _),
        servo.garbage_before_reply(b"\x00\xff\xff\xfd\xff"),
    ):
        reading = driver.read_position()
        assert reading.counts == -5
        assert reading.half_width_ns == 250_000 + 25_000


@both_protocols
def test_a_corrupted_answer_is_refused_at_once(protocol: int) -> None:
    with emulated(protocol=protocol) as (servo, driver, clock):
        t_ns = clock.now_ns()
        with servo.corrupt_crc(), pytest.raises(ServoPacketError, match="damaged"):
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
        assert driver.read_identity().model_number == 311


def test_a_servo_of_another_id_is_silent() -> None:
    with (
        emulated(timeout_s=SHORT_S, asked_id=2) as (_, driver, _),
        pytest.raises(ServoTimeoutError, match="servo 2 at 1000000 baud"),
    ):
        driver.read_identity()


def test_a_servo_at_another_baud_rate_is_silent() -> None:
    clock = VirtualClock()
    with FaultyServo(lambda _: 0, clock, baudrate=57_600) as servo:
        driver = open_servo(servo.port, baudrate=1_000_000, clock=clock, timeout_s=SHORT_S)
        with contextlib.closing(driver), pytest.raises(ServoTimeoutError, match="baud rate"):
            driver.read_identity()


@both_protocols
def test_an_alert_keeps_the_value(protocol: int) -> None:
    with emulated(lambda _: -5, protocol=protocol) as (servo, driver, _):
        with servo.alert():
            reading = driver.read_position()
            assert (reading.counts, reading.has_alert) == (-5, True)
            assert driver.read_identity().model_number == {1: 310, 2: 311}[protocol]
        assert not driver.read_position().has_alert
