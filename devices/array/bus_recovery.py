"""Recovery of an I2C bus that a chip holds: monitor, clocks on its wires, multiplexers' RESET.

Sources: UM10204 3.1.16, TCA9548A data sheet 6.7, hardware.md 2 and 8. A chip that lost count in
the middle of a byte waits for clocks with its bit on the line. A Raspberry Pi's adapter cannot send
them itself: it takes the low line for an acknowledge.

SDA and SCL belong to the I2C controller. Requesting them as GPIO disconnects it, and releasing them
leaves them inputs: libgpiod has no alternate functions. So Raspberry Pi OS's `pinctrl` (before
2023: `raspi-gpio`) restores the pins' function in every case.

Clocks and RESET have not been run on a Raspberry Pi by this project. Tests cover the calls of
libgpiod with the library's own types, and those of `pinctrl` by their command line.
"""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from devices.array.tile import Scan
from devices.chips.tca9548a import MuxRouter
from devices.clock import Clock
from devices.errors import BusFaultError, BusSetupError, require_extra
from devices.gpio import translate_gpio_errors
from devices.scene.hardware_sections import RecoverySection

if TYPE_CHECKING:
    from gpiod import LineRequest


_TOOLS = ("pinctrl", "raspi-gpio")
_TOOL_TIMEOUT_S = 5.0


class GpioLine:
    """Requested open-drain line: a released output is an input."""

    def __init__(self, request: LineRequest, line: int) -> None:
        self._request = request
        self._line = line

    def drive(self, *, low: bool) -> None:
        """Pull the line low, or release it."""
        from gpiod.line import Value

        self._request.set_value(self._line, Value.INACTIVE if low else Value.ACTIVE)

    def is_high(self) -> bool:
        """Return the level on the pin, whatever drives it."""
        return bool(self._request.get_value(self._line))


class GpioLines:
    """SCL, SDA and RESET of one bus.

    Raises:
        MissingExtraError: gpiod is not installed.
        BusSetupError: the tool that restores the pins is not installed.
    """

    def __init__(self, scene: RecoverySection) -> None:
        self._scene = scene
        with require_extra("gpio", "recovery of the bus"):
            import gpiod  # noqa: F401  # a later import must not be the first to fail
        tool = next(filter(None, map(shutil.which, _TOOLS)), None)
        if tool is None:
            raise BusSetupError(
                "no tool to give SDA and SCL back to the I2C controller, so they are not taken",
                where=scene.gpiochip,
                expected=f"{' or '.join(_TOOLS)}, as on Raspberry Pi OS",
                remedy="Install raspi-utils, or remove [recovery]",
            )
        self._restore_command = [
            tool,
            "set",
            f"{scene.sda_line},{scene.scl_line}",
            scene.i2c_function,
        ]

    @contextmanager
    def request_scl_sda(self) -> Iterator[tuple[GpioLine, GpioLine]]:
        """Request SCL and SDA from the I2C controller while the block runs, then restore them.

        Raises:
            BusSetupError: the lines cannot be requested, driven, or restored.
        """
        scl, sda = self._scene.scl_line, self._scene.sda_line
        try:
            with self._request_lines(scl, sda) as request:
                yield GpioLine(request, scl), GpioLine(request, sda)
        finally:
            self._restore_pin_function()

    def request_reset(self) -> AbstractContextManager[GpioLine] | None:
        """Request the multiplexers' RESET; None if the scene names no line for it."""
        line = self._scene.reset_line
        return None if line is None else self._request_reset_line(line)

    @contextmanager
    def _request_reset_line(self, line: int) -> Iterator[GpioLine]:
        with self._request_lines(line) as request:
            yield GpioLine(request, line)

    @contextmanager
    def _request_lines(self, *lines: int) -> Iterator[LineRequest]:
        import gpiod
        from gpiod.line import Direction, Drive, Value

        # Released from the first moment: the request must not pull a line low.
        open_drain = gpiod.LineSettings(
            direction=Direction.OUTPUT, drive=Drive.OPEN_DRAIN, output_value=Value.ACTIVE
        )
        with (
            translate_gpio_errors(self._scene.gpiochip, lines, "[recovery]"),
            gpiod.request_lines(
                self._scene.gpiochip, consumer="foottile", config={lines: open_drain}
            ) as request,
        ):
            yield request

    def _restore_pin_function(self) -> None:
        try:
            subprocess.run(  # noqa: S603  # found on the path, numbers from the scene
                self._restore_command,
                check=True,
                capture_output=True,
                text=True,
                timeout=_TOOL_TIMEOUT_S,
            )
        except (OSError, subprocess.SubprocessError) as error:
            reason = (getattr(error, "stderr", None) or str(error)).strip()
            raise BusSetupError(
                "SDA and SCL are still GPIO, the I2C controller is disconnected from them: "
                + reason,
                where=self._scene.gpiochip,
                remedy=f"Run: sudo {' '.join(self._restore_command)}; or reboot",
            ) from error


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


_RECOVERY_NS = (10_000_000, 1_000_000_000)
"""First and longest interval between recovery attempts."""

ADAPTER_REOPEN_NS = 1_000_000_000
"""Time without a working bus after which the adapter is reopened."""


@dataclass(frozen=True)
class RecoveryResult:
    """Result of an attempt to free the bus.

    Attributes:
        succeeded: True if the bus works again.
        problem: reason why a step could not be tried; empty if all were.
    """

    succeeded: bool
    problem: str = ""


def recover_bus(recovery: BusRecovery, is_bus_working: Callable[[], bool]) -> RecoveryResult:
    """Free a stuck bus by nine clocks, else by the multiplexers' RESET, until it works.

    High lines do not prove that the bus works: a slave may pull them low again. A GPIO line that is
    busy now may be free at the next attempt.
    """
    problems = []
    for help_ in (recovery.send_recovery_clocks, recovery.reset_muxes):
        try:
            helped = help_()
        except BusSetupError as error:
            problems.append(str(error))
            continue
        if helped and is_bus_working():
            return RecoveryResult(succeeded=True)
    return RecoveryResult(succeeded=False, problem="; ".join(problems))


class BusMonitor:
    """Monitor of one bus.

    A stuck SDA acknowledges everything and reads as zeros, an open one acknowledges nothing
    (hardware.md 3.2). To tell these from faulty tiles, the monitor writes a multiplexer's register
    and reads it back.
    """

    def __init__(self, router: MuxRouter, clock: Clock, recovery: BusRecovery | None) -> None:
        self.is_down = False
        self.recovery_attempts = 0
        """Number of recovery attempts."""
        self.problem = ""
        """Reason why the last recovery failed; empty after success or without recovery."""
        self._router = router
        self._clock = clock
        self._recovery = recovery
        self._wait_ns, self._due_ns = _RECOVERY_NS[0], 0
        self._renewal_due_ns = 0

    def check_bus(self, scan: Scan) -> None:
        """Check the bus after zeros or silence; abandon the frame if it fails."""
        if not self._is_working():
            scan.count_bus_fault(abandons_frame=True)

    def mark_down(self) -> None:
        """Mark the bus as down: no transfers to tiles until it works again."""
        self.is_down = True
        self.problem = ""
        self._wait_ns, self._due_ns = _RECOVERY_NS[0], 0
        self._renewal_due_ns = self._clock.now_ns() + ADAPTER_REOPEN_NS

    @property
    def warning(self) -> str:
        """Warning about the bus; empty if it works."""
        if not self.is_down:
            return ""
        if not self._router.bus.is_open:
            why = f": {self._router.bus.reopen_error}" if self._router.bus.reopen_error else ""
            return f"the adapter of the bus is missing; retry every second{why}"
        failure = f"; recovery failed: {self.problem}" if self.problem else ""
        return f"the bus is stuck or cut{failure}"

    def try_reconnect(self) -> bool:
        """Return whether a bus that was down works again; reopen or recover it if due."""
        bus = self._router.bus
        if not bus.ensure_open(self._clock.now_ns()):
            return False
        back = self._is_working()
        if not back and bus.is_open and self._clock.now_ns() >= self._renewal_due_ns:
            # After replugging a USB adapter its open file fails with EIO for ever.
            self._renewal_due_ns = self._clock.now_ns() + ADAPTER_REOPEN_NS
            bus.release_adapter()
            return False
        if not back and self._recovery is not None and self._clock.now_ns() >= self._due_ns:
            self.recovery_attempts += 1
            given = recover_bus(self._recovery, self._is_working)
            back, self.problem = given.succeeded, given.problem
            self._due_ns = self._clock.now_ns() + self._wait_ns
            self._wait_ns = min(2 * self._wait_ns, _RECOVERY_NS[1])
        self.is_down = not back
        return back

    def _is_working(self) -> bool:
        try:
            return self._router.check_any_mux_works()
        except BusFaultError:
            return False
