"""GPIO lines of a Raspberry Pi, through libgpiod's Python binding (version 2).

SDA and SCL belong to the I2C controller. Requesting them as GPIO disconnects it, and releasing them
leaves them inputs: libgpiod has no alternate functions. So Raspberry Pi OS's `pinctrl` (before
2023: `raspi-gpio`) restores the pins' function in every case.

This module has not been run on a Raspberry Pi by this project. Tests cover the calls of libgpiod
with the library's own types, and those of `pinctrl` by their command line.
"""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import TYPE_CHECKING

from devices.errors import BusSetupError, require_extra
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
        try:
            with gpiod.request_lines(
                self._scene.gpiochip, consumer="foottile", config={lines: open_drain}
            ) as request:
                yield request
        except OSError as error:
            raise BusSetupError(
                f"GPIO lines cannot be used ({error.strerror or error})",
                where=f"{self._scene.gpiochip}, lines {', '.join(map(str, lines))}",
                remedy="Check [recovery], that this user is in the group gpio, and that no other "
                "program holds the lines (gpioinfo)",
                errno=error.errno,
            ) from error

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
