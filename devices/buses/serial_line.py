"""Serial line of a servo: exclusive access, low-latency mode, latency timer.

An FTDI adapter buffers received bytes for the time of its latency timer, 16 ms by default, which
delays every short answer (hardware.md 5.2).
"""

from __future__ import annotations

import contextlib
import termios
from pathlib import Path
from typing import Protocol

import serial

from devices.errors import ServoLostError, ServoSetupError

SYSFS = Path("/sys/bus/usb-serial/devices")
BY_ID = Path("/dev/serial/by-id")
RECOMMENDED_LATENCY_MS = 1
"""Recommended latency timer."""

PORT_ERRORS = (OSError, termios.error)
SEND_TIMEOUT_ERROR = serial.SerialTimeoutException
"""Error of a request that was not sent in time, perhaps on a busy machine; the port still works."""


class SerialPort(Protocol):
    """Serial port of a servo: `serial.Serial`, or a test's."""

    def write(self, data: bytes, /) -> int | None:
        """Send `data`."""

    def read(self, size: int, /) -> bytes:
        """Read up to `size` bytes; fewer, or none, after the port's timeout."""

    def reset_input_buffer(self) -> None:
        """Discard all received bytes."""

    def close(self) -> None:
        """Release the port."""


def open_serial_line(port: str, baudrate: int, timeout_s: float) -> SerialPort:
    """Open a serial port for this program alone; a read waits `timeout_s` seconds at most.

    Raises:
        ServoLostError: there is no such port, it may not be used, or another program uses it.
        ServoSetupError: it cannot run at this baud rate.
    """
    try:
        line = serial.Serial(
            port, baudrate, timeout=timeout_s, write_timeout=timeout_s, exclusive=True
        )
    except (*PORT_ERRORS, ValueError) as error:
        kind = ServoSetupError if isinstance(error, ValueError) else ServoLostError
        raise kind(
            f"the serial port cannot be opened ({error})",
            where=port,
            remedy="Check that the device exists, that this user is in the group dialout, that no "
            "other program has it open, and the baud rate",
        ) from error
    # Saves up to 15 ms per read on FTDI adapters (hardware.md 5.2). Others refuse it: harmless.
    with contextlib.suppress(ValueError):
        line.set_low_latency_mode(True)
    return line


def find_stable_path(port: str, folder: Path = BY_ID) -> str:
    """Return a path of the adapter at `port` that stays valid after replugging.

    The kernel numbers adapters in order of plugging, so /dev/ttyUSB0 may become /dev/ttyUSB1, or
    another adapter. udev's links in `folder` are named after the adapter; without a link return
    `port`.
    """
    device = Path(port).resolve()
    try:
        links = sorted(link for link in folder.iterdir() if link.resolve() == device)
    except OSError:
        return port
    return str(links[0]) if links else port


def read_latency_timer_ms(port: str, sysfs: Path = SYSFS) -> int | None:
    """Read the latency timer of the adapter at `port`, in milliseconds; None if it has none.

    Only USB adapters with an FTDI chip have one. `port` may be a link, as in /dev/serial/by-id.
    """
    try:
        return int((sysfs / Path(port).resolve().name / "latency_timer").read_text())
    except (OSError, ValueError):
        return None


def check_latency_timer(port: str, sysfs: Path = SYSFS) -> str | None:
    """Return a warning, with remedy, if the latency timer of `port` is too long; else None."""
    timer_ms = read_latency_timer_ms(port, sysfs)
    if timer_ms is None or timer_ms <= RECOMMENDED_LATENCY_MS:
        return None
    return (
        f"{port}: the adapter holds every answer of the servo back for {timer_ms} ms (its latency "
        f"timer); expected {RECOMMENDED_LATENCY_MS} ms. Put this line into "
        "/etc/udev/rules.d/99-servo.rules "
        'and plug the adapter in again: ACTION=="add", SUBSYSTEM=="usb-serial", '
        f'DRIVER=="ftdi_sio", ATTR{{latency_timer}}="{RECOMMENDED_LATENCY_MS}"'
    )
