"""The driver and the servo search on an emulated servo behind a pseudo-terminal."""

from __future__ import annotations

import contextlib
from functools import partial

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from devices.chips.dynamixel.servo_setup import FoundServo, find_servos, open_servo
from devices.clock import SystemClock, VirtualClock
from devices.emulation.chips.dynamixel import FIRMWARE_VERSION
from devices.errors import ServoPacketError, ServoSetupError, ServoTimeoutError
from tests.builders.servo import FaultyServo
from tests.devices.chips.dynamixel.lines import AMPLE_S, SHORT_S, both_protocols, emulated

# Positions


@pytest.mark.parametrize("counts", [166, 2**31 - 1, -(2**31), 0x00FDFFFF])
def test_positions_of_protocol_2_are_signed_and_may_need_stuffing(counts: int) -> None:
    with emulated(lambda _: counts) as (_, driver, _):
        reading = driver.read_position()
    assert (reading.counts, reading.half_width_ns) == (counts, 250_000)


@both_protocols
@settings(max_examples=10, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(positions=st.lists(st.integers(-28_672, 28_672), min_size=1, max_size=10))
@example([0, -5, 4095, 4096])
def test_positions_below_zero_and_beyond_a_turn_are_read(
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
    sampled_ns: list[int] = []

    def position(t_ns: int) -> int:
        sampled_ns.append(t_ns)
        return t_ns % 5000 - 2500

    exchange_ns = request_ns + 500_000 + answer_ns
    assert f"{exchange_ns / 1e6:.2f}" == table_ms  # hardware.md 5.2
    with emulated(position, baudrate=baudrate, protocol=protocol) as (_, driver, clock):
        for _ in range(5):
            t_ns = clock.now_ns()
            reading = driver.read_position()
            assert sampled_ns[-1] - t_ns == request_ns + 500_000
            assert reading.t_mono_ns - t_ns == request_ns + 250_000
            assert reading.half_width_ns == 250_000
            assert reading.answered_ns == clock.now_ns() == t_ns + exchange_ns
            assert reading.counts == sampled_ns[-1] % 5000 - 2500


def test_an_answer_takes_the_time_of_the_wire_on_a_system_clock() -> None:
    clock = SystemClock()
    with FaultyServo(lambda _: 7, clock, baudrate=57_600) as servo:
        driver = open_servo(servo.port, baudrate=57_600, clock=clock, timeout_s=AMPLE_S)
        with contextlib.closing(driver):
            t_ns = clock.now_ns()
            reading = driver.read_position()
    assert reading.answered_ns - t_ns >= 5_534_721
    assert reading.half_width_ns >= 250_000


# Faults


@both_protocols
def test_garbage_before_an_answer_widens_its_interval(protocol: int) -> None:
    line = emulated(lambda _: -5, protocol=protocol)
    with line as (servo, driver, _), servo.garbage_before_reply(b"\x00\xff\xff\xfd\xff"):
        reading = driver.read_position()
    assert (reading.counts, reading.half_width_ns) == (-5, 250_000 + 25_000)


@both_protocols
def test_a_damaged_answer_is_refused_at_once(protocol: int) -> None:
    with emulated(protocol=protocol) as (servo, driver, clock):
        t_ns = clock.now_ns()
        with servo.corrupt_crc(), pytest.raises(ServoPacketError, match="damaged"):
            driver.read_position()
        assert clock.now_ns() - t_ns < 1_000_000
        assert driver.read_position().counts == 0


@pytest.mark.parametrize(
    ("asked", "reason"),
    [
        ({"servo_id": 2}, "servo 2 at 1000000 baud"),
        ({"baudrate": 57_600}, "baud rate"),
        ({"protocol": 1}, "servo 1 at 1000000 baud"),
        ({"protocol": 2}, "servo 1 at 1000000 baud"),
    ],
)
def test_a_servo_of_another_id_baud_rate_or_protocol_is_silent(
    asked: dict[str, int], reason: str
) -> None:
    protocol = 3 - asked["protocol"] if "protocol" in asked else 2
    with emulated(protocol=protocol, timeout_s=SHORT_S, asked=asked) as (_, driver, _):
        (warning,) = driver.opening_warnings
        assert "no answer" in warning
        assert f"that its firmware speaks Protocol {asked.get('protocol', 2)}.0" in warning
        with pytest.raises(ServoTimeoutError, match=reason):
            driver.read_identity()


@both_protocols
def test_a_reading_has_an_alert_as_long_as_the_servo_reports_one(protocol: int) -> None:
    with emulated(lambda _: -5, protocol=protocol) as (servo, driver, _):
        with servo.alert():
            reading = driver.read_position()
            assert (reading.counts, reading.has_alert) == (-5, True)
            assert driver.read_identity().model_number == {1: 310, 2: 311}[protocol]
        assert not driver.read_position().has_alert


# Opening


def test_a_port_that_cannot_be_opened_is_a_setup_error_with_a_remedy() -> None:
    with emulated() as (servo, _, clock):
        for port, baudrate, text in (
            ("/dev/no-such-port", 57_600, "cannot be opened.*group dialout"),
            (servo.port, 1_000_000, "cannot be opened"),  # in use
            ("/dev/null", 57_600, "cannot be opened"),
            (servo.port, -1, "cannot be opened"),
        ):
            with pytest.raises(ServoSetupError, match=text):
                open_servo(port, baudrate=baudrate, clock=clock)


def test_an_unplugged_adapter_is_a_setup_error() -> None:
    with emulated() as (servo, driver, _):
        assert driver.read_identity().model_number == 311
        servo.close()
        with pytest.raises(ServoSetupError, match="serial port failed"):
            driver.read_position()


@pytest.mark.parametrize("model", ["MX-28", "MX-64"])
@both_protocols
def test_the_servo_of_the_scene_is_opened_without_a_warning(model: str, protocol: int) -> None:
    line = emulated(lambda _: 7, model=model, protocol=protocol, asked={"model": model})
    with line as (_, driver, _):
        assert driver.opening_warnings == ()
        assert driver.read_position().counts == 7


@both_protocols
def test_another_model_is_refused_with_the_key_to_set_and_its_port_is_closed(
    protocol: int,
) -> None:
    clock = VirtualClock()
    with FaultyServo(lambda _: 0, clock, model="MX-28", protocol=protocol) as servo:
        open_model = partial(
            open_servo, servo.port, baudrate=1_000_000, clock=clock, protocol=protocol
        )
        with pytest.raises(ServoSetupError, match=r'expected an MX-64 .* Set model = "MX-28"'):
            open_model(model="MX-64")
        open_model(model="MX-28").close()


@both_protocols
def test_a_servo_that_is_silent_at_first_is_read_once_it_answers(protocol: int) -> None:
    clock = VirtualClock()
    with FaultyServo(lambda _: -4097, clock, protocol=protocol) as servo:
        with servo.silent():
            driver = open_servo(
                servo.port, baudrate=1_000_000, clock=clock, timeout_s=0.5, protocol=protocol
            )
        with contextlib.closing(driver):
            assert len(driver.opening_warnings) == 1
            assert driver.read_position().counts == -4097


def test_a_slow_adapter_is_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    check = "devices.chips.dynamixel.servo_setup.check_latency_timer"
    monkeypatch.setattr(check, lambda port: f"{port} is slow")
    with emulated() as (servo, driver, _):
        assert driver.opening_warnings == (f"{servo.port} is slow",)


# Search for a servo of unknown protocol and baud rate

# In real time; ample for an emulated servo even where the machine is busy.
TIMEOUT_S = 0.3


@pytest.mark.real_time
@pytest.mark.parametrize(
    ("protocol", "model", "number"),
    [(1, "MX-28", 29), (1, "MX-64", 310), (2, "MX-28", 30), (2, "MX-64", 311)],
)
@pytest.mark.parametrize("baudrate", [57_600, 3_000_000])
def test_a_servo_of_any_protocol_and_baud_rate_is_found(
    protocol: int, model: str, number: int, baudrate: int
) -> None:
    clock = VirtualClock()
    with FaultyServo(
        lambda _: 0, clock, servo_id=3, model=model, protocol=protocol, baudrate=baudrate
    ) as servo:
        found = find_servos(
            servo.port,
            clock,
            servo_ids=(3, 253),
            baudrates=(57_600, 3_000_000),
            timeout_s=TIMEOUT_S,
        )
    assert found == [FoundServo(3, baudrate, protocol, model, number, FIRMWARE_VERSION)]


def test_a_silent_servo_and_a_damaged_answer_are_not_found() -> None:
    clock = VirtualClock()
    with FaultyServo(lambda _: 0, clock) as servo:
        with servo.silent():
            assert find_servos(servo.port, clock, timeout_s=0.01) == []
        with servo.corrupt_crc():
            assert find_servos(servo.port, clock, baudrates=(1_000_000,), timeout_s=0.02) == []


def test_a_missing_port_cannot_be_searched() -> None:
    with pytest.raises(ServoSetupError, match="cannot be opened"):
        find_servos("/dev/no-such-port", VirtualClock())
