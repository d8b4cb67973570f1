"""Search for a servo of unknown protocol and baud rate."""

from __future__ import annotations

import pytest

from devices.chips.dynamixel.servo_search import FoundServo, find_servos
from devices.clock import VirtualClock
from devices.emulation.chips.dynamixel import FIRMWARE_VERSION
from devices.errors import ServoSetupError
from tests.builders.servo import FaultyServo

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
