"""Freeing an I2C bus whose SDA a chip holds low: nine clocks and a STOP, then the muxes' RESET.

Sources: UM10204 3.1.16, TCA9548A data sheet 6.7, hardware.md 2 and 8. A chip that lost count in
the middle of a byte waits for clocks with its bit on the line. A Raspberry Pi's adapter sends none
by itself, and cannot: it takes a line that is low for an acknowledge.
"""

from __future__ import annotations

from contextlib import AbstractContextManager
from typing import Protocol

from devices.clock import Clock
from devices.recovery.gpio import GpioLines
from devices.scene.hardware import RecoveryScene

CLOCKS = 9
"""The rest of a byte and its acknowledge, from wherever it was broken off."""

HALF_PERIOD_NS = 5_000
"""100 kHz, which every chip follows."""

RESET_NS = 10_000
"""At least 6 ns (TCA9548A 6.7); long leads and a weak pull-up take longer."""


class BusRecovery(Protocol):
    """What can be done about a bus that is stuck. Not while a transfer is under way."""

    def clock_out(self) -> bool:
        """Clock the chip that holds SDA through its byte, and send a STOP.

        Returns:
            True if SDA and SCL are high in the end, so that the bus can be used.

        Raises:
            BusSetupError: the lines cannot be had or given back.
        """

    def reset_muxes(self) -> bool:
        """Pulse the multiplexers' RESET line: no channel is open behind it, whatever was before.

        Returns:
            False if the line is not wired.

        Raises:
            BusSetupError: the line cannot be had.
        """


class Line(Protocol):
    """An open-drain wire: every device may pull it low, none can pull it high."""

    def drive(self, *, low: bool) -> None:
        """Pull it low, or let go."""

    def high(self) -> bool:
        """Is it high, that is, does no device pull it low?"""


class Lines(Protocol):
    """Where the wires come from. They are ours while the block runs, and let go at first."""

    def bus(self) -> AbstractContextManager[tuple[Line, Line]]:
        """SCL and SDA."""

    def reset(self) -> AbstractContextManager[Line] | None:
        """RESET of all multiplexers; None if it is not wired."""


class GpioRecovery:
    """`BusRecovery` by moving wires one edge at a time."""

    def __init__(self, lines: Lines, clock: Clock) -> None:
        self._lines = lines
        self._clock = clock

    def clock_out(self) -> bool:
        """As `BusRecovery.clock_out`; it gives up on a held SCL, and on SDA after nine clocks."""
        with self._lines.bus() as (scl, sda):
            self._wait(HALF_PERIOD_NS)
            for _ in range(CLOCKS):
                if not scl.high():
                    return False  # no chip here stretches clocks (hardware.md 3.2): it is stuck
                if not sda.high():
                    self._drive(scl, low=True)
                    self._drive(scl, low=False)
                elif self._stop(scl, sda):
                    return True
                # Else a high bit came before a low one. The failed STOP was a clock, too.
            return scl.high() and sda.high() and self._stop(scl, sda)

    def reset_muxes(self) -> bool:
        """As `BusRecovery.reset_muxes`."""
        line = self._lines.reset()
        if line is None:
            return False
        with line as reset:
            reset.drive(low=True)
            self._wait(RESET_NS)
            reset.drive(low=False)
            self._wait(RESET_NS)
        return True

    def _stop(self, scl: Line, sda: Line) -> bool:
        """SDA rises while SCL is high; False if one of them is held."""
        self._drive(scl, low=True)
        self._drive(sda, low=True)
        self._drive(scl, low=False)
        self._drive(sda, low=False)
        return scl.high() and sda.high()

    def _drive(self, line: Line, *, low: bool) -> None:
        line.drive(low=low)
        self._wait(HALF_PERIOD_NS)

    def _wait(self, duration_ns: int) -> None:
        self._clock.sleep_until_ns(self._clock.now_ns() + duration_ns)


def open_recovery(scene: RecoveryScene | None, clock: Clock) -> BusRecovery | None:
    """Recovery through the GPIO lines of `scene`; None without such a section.

    Every line is taken once and given back, so that what is missing is said at the start and not in
    the mud. The bus must be idle meanwhile.

    Raises:
        MissingExtraError: gpiod is not installed.
        BusSetupError: the tool that gives pins back is not installed, or a line is in use.
    """
    if scene is None:
        return None
    lines = GpioLines(scene)
    with lines.bus():
        pass
    reset = lines.reset()
    if reset is not None:
        with reset:
            pass
    return GpioRecovery(lines, clock)
