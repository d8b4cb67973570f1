"""Recovery of an I2C bus whose SDA a chip holds low: nine clocks and a STOP, then the muxes' RESET.

Sources: UM10204 3.1.16, TCA9548A data sheet 6.7, hardware.md 2 and 8. A chip that lost count in
the middle of a byte waits for clocks with its bit on the line. A Raspberry Pi's adapter cannot send
them itself: it takes the low line for an acknowledge.
"""

from __future__ import annotations

from contextlib import AbstractContextManager
from typing import Protocol

from devices.clock import Clock
from devices.recovery.gpio import GpioLines
from devices.scene.hardware_sections import RecoverySection

RECOVERY_CLOCKS = 9
"""Clocks for the rest of any interrupted byte and its acknowledge."""

HALF_PERIOD_NS = 5_000
"""Half a clock period at 100 kHz, which every chip supports."""

RESET_NS = 10_000
"""Length of the RESET pulse: at least 6 ns (TCA9548A 6.7); long leads and a weak pull-up need more.
"""


class BusRecovery(Protocol):
    """Recovery steps for a stuck bus. Never call them during a transfer."""

    def send_recovery_clocks(self) -> bool:
        """Clock the chip that holds SDA through its byte, and send a STOP.

        Returns:
            True if SDA and SCL are high in the end, so that the bus can be used.

        Raises:
            BusSetupError: the lines cannot be requested or released.
        """

    def reset_muxes(self) -> bool:
        """Pulse the multiplexers' RESET line, which closes all channels.

        Returns:
            False if the line is not wired.

        Raises:
            BusSetupError: the line cannot be requested.
        """


class OpenDrainLine(Protocol):
    """Open-drain wire: every device may pull it low, none can pull it high."""

    def drive(self, *, low: bool) -> None:
        """Pull the line low, or release it."""

    def is_high(self) -> bool:
        """Return whether the line is high: no device pulls it low."""


class GpioBusLines(Protocol):
    """Wires of a bus as GPIO, requested while a block runs; released, so high, at first."""

    def request_scl_sda(self) -> AbstractContextManager[tuple[OpenDrainLine, OpenDrainLine]]:
        """Request SCL and SDA."""

    def request_reset(self) -> AbstractContextManager[OpenDrainLine] | None:
        """Request RESET of all multiplexers; None if it is not wired."""


class GpioRecovery:
    """Recovery by GPIO, one edge at a time."""

    def __init__(self, lines: GpioBusLines, clock: Clock) -> None:
        self._lines = lines
        self._clock = clock

    def send_recovery_clocks(self) -> bool:
        """Send clocks as `BusRecovery` does; fail on a held SCL, or on SDA after nine clocks."""
        with self._lines.request_scl_sda() as (scl, sda):
            self._wait(HALF_PERIOD_NS)
            for _ in range(RECOVERY_CLOCKS):
                if not scl.is_high():
                    return False  # no chip here stretches clocks (hardware.md 3.2): it is stuck
                if not sda.is_high():
                    self._drive(scl, low=True)
                    self._drive(scl, low=False)
                elif self._send_stop(scl, sda):
                    return True
                # Else a high bit preceded a low one. The failed STOP was a clock, too.
            return scl.is_high() and sda.is_high() and self._send_stop(scl, sda)

    def reset_muxes(self) -> bool:
        """Pulse RESET as `BusRecovery.reset_muxes`."""
        line = self._lines.request_reset()
        if line is None:
            return False
        with line as reset:
            reset.drive(low=True)
            self._wait(RESET_NS)
            reset.drive(low=False)
            self._wait(RESET_NS)
        return True

    def _send_stop(self, scl: OpenDrainLine, sda: OpenDrainLine) -> bool:
        """Send a STOP (SDA rises while SCL is high); return False if a line is held low."""
        self._drive(scl, low=True)
        self._drive(sda, low=True)
        self._drive(scl, low=False)
        self._drive(sda, low=False)
        return scl.is_high() and sda.is_high()

    def _drive(self, line: OpenDrainLine, *, low: bool) -> None:
        line.drive(low=low)
        self._wait(HALF_PERIOD_NS)

    def _wait(self, duration_ns: int) -> None:
        self._clock.sleep_until_ns(self._clock.now_ns() + duration_ns)


def open_gpio_recovery(scene: RecoverySection | None, clock: Clock) -> BusRecovery | None:
    """Open the recovery through the GPIO lines of `scene`; None without such a section.

    Requests and releases every line once, so that a fault shows at the start and not in the field.
    The bus must be idle meanwhile.

    Raises:
        MissingExtraError: gpiod is not installed.
        BusSetupError: the tool that restores pins is not installed, or a line is in use.
    """
    if scene is None:
        return None
    lines = GpioLines(scene)
    with lines.request_scl_sda():
        pass
    reset = lines.request_reset()
    if reset is not None:
        with reset:
            pass
    return GpioRecovery(lines, clock)
