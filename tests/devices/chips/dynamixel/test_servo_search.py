"""Finding a servo whose protocol and baud rate nobody remembers."""

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
def test_a_servo_is_found_whatever_it_speaks(
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


def test_nobody_is_found_where_nobody_answers() -> None:
    with FaultyServo(lambda _: 0, VirtualClock()) as servo, servo.silent():
        assert find_servos(servo.port, VirtualClock(), timeout_s=0.01) == []


def test_a_damaged_answer_is_no_servo() -> None:
    with FaultyServo(lambda _: 0, VirtualClock()) as servo, servo.corrupt_crc():
        assert find_servos(servo.port, VirtualClock(), baudrates=(1_000_000,), timeout_s=0.02) == []


def test_a_port_that_is_not_there_cannot_be_probed() -> None:
    with pytest.raises(ServoSetupError, match="cannot be opened"):
        find_servos("/dev/no-such-port", VirtualClock())
