"""Search for servos of unknown protocol and baud rate on a serial line."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from dataclasses import dataclass

from devices.buses.serial_line import open_serial_line
from devices.chips.dynamixel.driver import DynamixelServo
from devices.chips.dynamixel.protocol import FIRMWARES, find_model
from devices.clock import Clock
from devices.errors import ServoPacketError, ServoStatusError, ServoTimeoutError

BAUDRATES = (57_600, 1_000_000, 115_200, 2_000_000, 3_000_000)
"""Baud rates to try: the factory's first, then the more usual ones."""


@dataclass(frozen=True, slots=True)
class FoundServo:
    """Servo found by the search."""

    servo_id: int
    baudrate: int
    protocol: int
    """Protocol version of its answer, 1 or 2."""
    model: str | None
    """Model name; None if it is no MX-28 or MX-64."""
    model_number: int
    firmware_version: int


def find_servos(
    port: str,
    clock: Clock,
    *,
    servo_ids: Iterable[int] = (1,),
    baudrates: Iterable[int] = BAUDRATES,
    timeout_s: float = 0.05,
) -> list[FoundServo]:
    """Try every id at every baud rate in both protocols; return the servos that answer, in order.

    Every silence costs `timeout_s` seconds: half a second for one id and all rates, two minutes
    for all ids. The default is ample for an answer at 57600 baud (4 ms) through an FTDI adapter
    with its default latency timer (16 ms). Servos are only read, never set.

    Raises:
        ServoSetupError: the port cannot be opened, or fails.
    """
    servo_ids = tuple(servo_ids)
    found = []
    for baudrate in baudrates:
        with contextlib.closing(open_serial_line(port, baudrate, timeout_s)) as line:
            for protocol, firmware in FIRMWARES.items():
                for servo_id in servo_ids:
                    if servo_id > firmware.protocol.max_servo_id:
                        continue
                    servo = DynamixelServo(
                        line,
                        clock,
                        servo_id=servo_id,
                        baudrate=baudrate,
                        timeout_s=timeout_s,
                        protocol=protocol,
                    )
                    # At a wrong rate an answer is noise, or absent.
                    with contextlib.suppress(ServoTimeoutError, ServoPacketError, ServoStatusError):
                        identity = servo.read_identity()
                        known = find_model(identity.model_number)
                        found.append(
                            FoundServo(
                                servo_id=servo_id,
                                baudrate=baudrate,
                                protocol=protocol,
                                model=None if known is None else known[0],
                                model_number=identity.model_number,
                                firmware_version=identity.firmware_version,
                            )
                        )
    return found
