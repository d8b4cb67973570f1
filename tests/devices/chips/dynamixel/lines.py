"""A servo on a serial line, emulated or scripted."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

import pytest

from devices.chips.dynamixel.driver import DynamixelServo, open_servo
from devices.clock import VirtualClock
from tests.builders.servo import FaultyServo

# In real time. No test waits for the ample one; where a time-out is to happen, it is short.
AMPLE_S = 5.0
SHORT_S = 0.02


@contextlib.contextmanager
def emulated(
    position: Callable[[int], int] = lambda _: 0,
    baudrate: int = 1_000_000,
    timeout_s: float = AMPLE_S,
    asked_id: int = 1,
    protocol: int = 2,
) -> Iterator[tuple[FaultyServo, DynamixelServo, VirtualClock]]:
    clock = VirtualClock(t_ns=1_000_000_000)
    with FaultyServo(position, clock, baudrate=baudrate, protocol=protocol) as servo:
        driver = open_servo(
            servo.port,
            baudrate=baudrate,
            clock=clock,
            servo_id=asked_id,
            timeout_s=timeout_s,
            protocol=protocol,
        )
        with contextlib.closing(driver):
            yield servo, driver, clock


both_protocols = pytest.mark.parametrize("protocol", [1, 2])
