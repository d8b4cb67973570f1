"""Set-up of servos on a serial line: opening a known one, search for one of unknown settings."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from devices.buses.serial_line import (
    SerialPort,
    check_latency_timer,
    find_stable_path,
    open_serial_line,
)
from devices.chips.dynamixel.driver import DynamixelServo
from devices.chips.dynamixel.protocol import FIRMWARES, find_model
from devices.clock import Clock
from devices.errors import (
    ServoError,
    ServoLostError,
    ServoPacketError,
    ServoSetupError,
    ServoStatusError,
    ServoTimeoutError,
)

BAUDRATES = (57_600, 1_000_000, 115_200, 2_000_000, 3_000_000)
"""Baud rates to try: the factory's first, then the more usual ones."""


def open_servo(
    port: str | Callable[[], str],
    *,
    baudrate: int,
    clock: Clock,
    servo_id: int = 1,
    timeout_s: float = 0.1,
    port_timeout_s: float | None = None,
    model: str = "MX-64",
    protocol: int = 2,
    allows_missing_port: bool = False,
) -> DynamixelServo:
    """Open the servo at `port` (such as /dev/ttyUSB0) and check its model.

    A silent servo is opened as well, since it may start later: silence and a slow adapter are
    its `opening_warnings`. A port that fails later is reopened by its path, or by udev's link to
    its adapter.

    The default `timeout_s`, in seconds, is ample for the slowest case: 9600 baud (30 ms), the
    longest return delay (0.5 ms) and an FTDI's default latency timer (16 ms).

    Args:
        port: path, or a function that returns it at each attempt (an emulated servo's).
        baudrate: baud rate of the line.
        clock: virtual or real clock.
        servo_id: id of the servo.
        timeout_s: timeout of an answer, by the clock.
        port_timeout_s: read timeout of the port, in real time: more than `timeout_s` on a virtual
            clock, where a busy machine must not look like silence. None: `timeout_s`.
        model: "MX-28" or "MX-64".
        protocol: 1 or 2.
        allows_missing_port: a missing port is a warning, and is opened as soon as it exists.

    Raises:
        ServoLostError: the port is missing, not permitted, or used by another program.
        ServoSetupError: another model or firmware than `model` and `protocol` answers.
    """
    path = port if isinstance(port, str) else port()

    def reopen() -> SerialPort:
        nonlocal path
        if not isinstance(port, str):
            path = port()
        line = open_serial_line(
            path, baudrate, timeout_s if port_timeout_s is None else port_timeout_s
        )
        path = find_stable_path(path)
        return line

    remarks: list[str] = []
    line: SerialPort | None = None
    try:
        line = reopen()
    except ServoLostError as error:
        if not allows_missing_port:
            raise
        remarks.append(f"the servo is not there yet: {error}")
    servo = DynamixelServo(
        line,
        clock,
        servo_id=servo_id,
        baudrate=baudrate,
        timeout_s=timeout_s,
        protocol=protocol,
        model=model,
        reopen=reopen,
    )
    if line is not None:
        if slow := check_latency_timer(path):
            remarks.append(slow)
        try:
            servo.check_model(model)
            with contextlib.suppress(ServoTimeoutError, ServoPacketError):
                servo.check_uptime()
        except ServoSetupError:
            servo.close()
            raise
        except ServoError as error:
            remarks.append(str(error))
    servo.opening_warnings = tuple(remarks)
    return servo


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
