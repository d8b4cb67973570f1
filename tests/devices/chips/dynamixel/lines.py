"""The driver on an emulated servo."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import pytest

from devices.chips.dynamixel.driver import DynamixelServo
from devices.chips.dynamixel.servo_setup import open_servo
from devices.clock import VirtualClock
from devices.emulation.fault_timing import FaultTiming
from tests.builders.servo import FaultyServo

# In real time. No test waits for the ample timeout; a timeout that a test expects is short.
AMPLE_S = 5.0
SHORT_S = 0.02

both_protocols = pytest.mark.parametrize("protocol", [1, 2])


class Line(NamedTuple):
    servo: FaultyServo
    driver: DynamixelServo
    clock: VirtualClock


@contextlib.contextmanager
def emulated(
    position: Callable[[int], int] = lambda _: 0,
    *,
    timeout_s: float = AMPLE_S,
    protocol: int = 2,
    baudrate: int = 1_000_000,
    asked: dict[str, Any] | None = None,
    table: tuple[int, bytes] | None = None,
    **facts: Any,
) -> Iterator[Line]:
    """Open a servo on a virtual clock.

    `asked` are options of the driver that do not match the servo, `table` are registers and
    `facts` options of the servo.
    """
    clock = VirtualClock(1_000_000_000)
    for fault in facts.values():
        if isinstance(fault, FaultTiming):
            fault.begin_scene_time(clock.now_ns())
    with FaultyServo(position, clock, protocol=protocol, baudrate=baudrate, **facts) as servo:
        if table is not None:
            servo.write_table(*table)
        options = {"baudrate": baudrate, "timeout_s": timeout_s, "protocol": protocol}
        driver = open_servo(lambda: servo.port, clock=clock, **(options | (asked or {})))
        with contextlib.closing(driver):
            yield Line(servo, driver, clock)
